"""Captures of the same test images through every lens, with the answers of the networks."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas
from safetensors.numpy import load_file

from tasklens.runtime.files import read_table
from tasklens.settings.names import SHARP, measured_name
from tasklens.show import pictures


@dataclass(frozen=True)
class Tile:
    """A capture at a field: data URI, text alternative, field, and a row for the answer of each network."""

    link: str
    alternative: str
    field: str
    answers: list[dict[Any, Any]]


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
    answers["right"] = answers["answer"] == answers["label"]
    images = answers[["image", "label"]].drop_duplicates().to_numpy().tolist()  # in the order of the arrays
    answers = answers.sort_values("classifier", key=lambda names: names != supervisor, kind="stable")
    entries = []
    for position, (image, label) in enumerate(images):
        captures = {}
        for (lens, restored), rows in answers[answers["image"] == image].groupby(["lens", "restored"], sort=False):
            array = arrays[measured_name(str(lens), bool(restored))][position]
            captures[str(lens), bool(restored)] = [
                Tile(pictures.of_array(array[k]), _alternative(of_field), str(field), of_field.to_dict("records"))
                for k, (field, of_field) in enumerate(rows.groupby("field", sort=False))
            ]
        (sharp,) = captures.pop((SHARP, False))
        entries.append(ImageCaptures(image, label, sharp, captures))
    return entries


def _alternative(rows: pandas.DataFrame) -> str:
    """Describe a capture and the answers in its rows."""
    label, lens, field = rows[["label", "lens", "field"]].iloc[0]
    place = f"{label} through {lens}, {field}" if field else f"{label}, sharp"
    return f"{place}. {'; '.join(rows['classifier'] + ' answers ' + rows['answer'])}"
