"""Captures of the same test images through every lens, with the answers of the networks."""

from dataclasses import dataclass
from pathlib import Path

import numpy
import pandas
from safetensors.numpy import load_file

from tasklens.report.page import pictures
from tasklens.runtime.files import read_table
from tasklens.study.names import SHARP, measured


@dataclass(frozen=True)
class Answer:
    """The answer of a network: its name, the class, the probability of the class [%], and whether it is right."""

    classifier: str
    answer: str
    probability: float
    right: bool


@dataclass(frozen=True)
class Tile:
    """A capture at a field: data link, text alternative, field, answers."""

    link: str
    alternative: str
    field: str
    answers: list[Answer]


@dataclass(frozen=True)
class Shown:
    """A test image: its number and label, its sharp tile, and its captures by (lens, whether restored)."""

    image: int
    label: str
    sharp: Tile
    captures: dict[tuple[str, bool], list[Tile]]


def shown(captures_file: Path, answers_file: Path, supervisor: str) -> list[Shown]:
    """Read captures and answers; the answers of the supervisor come first."""
    arrays = load_file(captures_file)
    texts = dict.fromkeys(("label", "answer", "lens", "classifier", "field"), str)
    answers = read_table(answers_file, keep_default_na=False, dtype=texts)
    answers = answers.sort_values("classifier", key=lambda names: names != supervisor, kind="stable")
    images = answers[["image", "label"]].drop_duplicates()
    images = images.set_index("image").loc[list(dict.fromkeys(_in_order(answers_file)))]
    entries = []
    for position, (image, label) in enumerate(images["label"].items()):
        image_rows = answers[answers["image"] == image]
        captures = {}
        for lens, restored in dict.fromkeys(zip(image_rows["lens"], _truth(image_rows["restored"]), strict=True)):
            rows = image_rows[(image_rows["lens"] == lens) & (_truth(image_rows["restored"]) == restored)]
            array = arrays[measured(lens, restored)][position]
            captures[lens, restored] = [
                _tile(array[k], lens, field, str(label), rows[rows["field"] == field])
                for k, field in enumerate(dict.fromkeys(rows["field"]))
            ]
        sharp = captures.pop((SHARP, False), None)
        tile = sharp[0] if sharp else _tile(arrays[SHARP][position, 0], SHARP, "", str(label), image_rows[:0])
        entries.append(Shown(int(str(image)), str(label), tile, captures))
    return entries


def _in_order(path: Path) -> list[int]:
    return read_table(path, usecols=["image"])["image"].tolist()


def _truth(column: pandas.Series) -> pandas.Series:
    return column.astype(str) == "True"


def _tile(array: numpy.ndarray, lens: str, field: str, label: str, rows: pandas.DataFrame) -> Tile:
    answers = [
        Answer(row["classifier"], row["answer"], float(row["probability"]), row["answer"] == label)
        for row in rows.to_dict("records")
    ]
    text = "; ".join(f"{answer.classifier} answers {answer.answer}" for answer in answers)
    place = f"{label} through {lens}, {field}" if field else f"{label}, sharp"
    return Tile(pictures.of_array(array), f"{place}. {text}", field, answers)
