"""Captures of the same test images through every lens, with the answers of the networks."""

from pathlib import Path
from typing import Any

import pandas
from safetensors.numpy import load_file

from tasklens.runtime.files import read_table
from tasklens.settings.names import SHARP, measured_name
from tasklens.show import pictures


def read(captures_file: Path, answers_file: Path, supervisor: str) -> list[dict[str, Any]]:
    """Read captures and answers of each test image; the answers of the supervisor come first.

    An entry has the number of the `image`, its `label`, its `sharp` tile, and the tiles of its `captures` by (lens,
    whether restored). A tile is a capture at a `field`: its `link` (data URI), its text `alternative`, and its
    `answers`, a row for each network.
    """
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
                {
                    "link": pictures.of_array(array[k]),
                    "alternative": _alternative(of_field),
                    "field": field,
                    "answers": of_field.to_dict("records"),
                }
                for k, (field, of_field) in enumerate(rows.groupby("field", sort=False))
            ]
        (sharp,) = captures.pop((SHARP, False))
        entries.append({"image": image, "label": label, "sharp": sharp, "captures": captures})
    return entries


def _alternative(rows: pandas.DataFrame) -> str:
    """Describe a capture and the answers in its rows."""
    label, lens, field = rows[["label", "lens", "field"]].iloc[0]
    place = f"{label} through {lens}, {field}" if field else f"{label}, sharp"
    return f"{place}. {'; '.join(rows['classifier'] + ' answers ' + rows['answer'])}"
