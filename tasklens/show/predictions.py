"""Read predictions: which test images were classified correctly at each field."""

from pathlib import Path

import pandas

from tasklens.runtime.files import FileError, damage_error, read_table

Labelled = pandas.DataFrame | pandas.Series  # with a row per image


def read(path: Path, fields: str = "field") -> pandas.DataFrame:
    """Read predictions: 1 if an image is classified correctly, else 0; a row per (image, label), a column per field.

    Args:
        fields: name of the set of fields; `field`: those of the grading.

    Raises:
        FileError: the file is not a table of predictions, or has none at these fields.
    """
    try:
        frame = read_table(path, dtype={"label": str}, keep_default_na=False).set_index(["image", "label"])
    except KeyError as error:
        raise damage_error(path, f"not a table of predictions ({error})") from error
    frame = frame.filter(regex=rf"^{fields}\d+$")
    if frame.empty or not frame.isin([0, 1]).all(axis=None):
        raise damage_error(path, "expected a row per image, with 0 or 1 for each field")
    return frame


def has(path: Path, fields: str) -> bool:
    """Return whether predictions were measured at a set of fields, which `read` then reads."""
    with path.open(encoding="utf-8") as file:
        return any(name.startswith(fields) for name in file.readline().split(","))


def accuracy_by_field(correct: pandas.DataFrame) -> list[float]:
    """Compute the accuracy [%] at each field."""
    return (100 * correct.mean()).tolist()


def same_images(first: Labelled, second: Labelled, where: str) -> None:
    """Check that two tables have the same images in the same order; raises FileError."""
    if not first.index.equals(second.index):
        raise FileError(f"{where}: test images differ; rerun both")
