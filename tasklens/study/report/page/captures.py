"""Captures of the same test images through every lens, with the answers of the networks."""

from dataclasses import dataclass
from pathlib import Path

import numpy
import pandas
from safetensors.numpy import load_file

from tasklens.runtime.files import read_table
from tasklens.settings.names import SHARP, measured
from tasklens.show import pictures


@dataclass(frozen=True)
class Answer:
    """The answer of a network: its name, the class, the probability of the class [%], and whether it is right."""

    classifier: str
    answer: str
    probability: float
    right: bool


@dataclass(frozen=True)
class Tile:
    """A capture at a field: data URI, text alternative, field, answers."""

    link: str
    alternative: str
    field: str
    answers: list[Answer]


@dataclass(frozen=True)
class ImageCaptures:
    """A test image: its number and label, its sharp tile, and its captures by (lens, whether restored)."""

    image: int
    label: str
    sharp: Tile
    captures: dict[tuple[str, bool], list[Tile]]


def read(captures_file: Path, answers_file: Path, supervisor: str) -> list[ImageCaptures]:
    """Read captures and answers; the answers of the supervisor come first."""
    arrays = load_file(captures_file)
    texts = dict.fromkeys(("label", "answer", "lens", "classifier", "field"), str)
    answers = read_table(answers_file, keep_default_na=False, dtype=texts)
    images = answers[["image", "label"]].drop_duplicates().to_numpy().tolist()  # in the order of the arrays
    answers = answers.sort_values("classifier", key=lambda names: names != supervisor, kind="stable")
    entries = []
    for position, (image, label) in enumerate(images):
        captures = {}
        for (lens, restored), rows in answers[answers["image"] == image].groupby(["lens", "restored"], sort=False):
            array = arrays[measured(str(lens), bool(restored))][position]
            captures[str(lens), bool(restored)] = [
                _tile(array[k], str(lens), str(field), label, of_field)
                for k, (field, of_field) in enumerate(rows.groupby("field", sort=False))
            ]
        (sharp,) = captures.pop((SHARP, False))
        entries.append(ImageCaptures(image, label, sharp, captures))
    return entries


def _tile(array: numpy.ndarray, lens: str, field: str, label: str, rows: pandas.DataFrame) -> Tile:
    answers = [
        Answer(row["classifier"], row["answer"], float(row["probability"]), row["answer"] == label)
        for row in rows.to_dict("records")
    ]
    text = "; ".join(f"{answer.classifier} answers {answer.answer}" for answer in answers)
    place = f"{label} through {lens}, {field}" if field else f"{label}, sharp"
    return Tile(pictures.of_array(array), f"{place}. {text}", field, answers)
