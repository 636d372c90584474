"""Measurements of a study, from its files of lenses, metrics and predictions; does not import torch."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import pandas

from tasklens.optics.io import lens_digest
from tasklens.recognition.metrics import accuracy_by_field, mean_metrics
from tasklens.runtime.files import damage_error, read_table, read_yaml
from tasklens.show import predictions
from tasklens.study.claims import Claim, Claims
from tasklens.study.table_contents import LensKey, MeasuredKey, SeededMeasurements

FIELD = "accuracy_field"  # beginning of the columns of accuracy by field
LEAST_ENERGY = 0.5  # inside the PSF window, mean over fields; a design with less failed
_Accuracy = TypeVar("_Accuracy", float, pandas.DataFrame)


def lens_values(content: Mapping[str, Any]) -> dict[str, float]:
    """Return means over the sensor of RMS and core radius [um] and energy inside the window, and worst margin.

    The worst margin is negative if the lens violates a limit of manufacturing [mm], focal length or distortion.
    """
    return {**content["means"], "worst_margin": content["worst_margin"]["value"]}


@dataclass(frozen=True)
class MeasurementFiles:
    """Files of lenses, metrics and predictions, as rules name them."""

    lenses: Sequence[Path]
    metrics: Sequence[Path]
    predictions: Sequence[Path]


@dataclass(frozen=True)
class Measurements:
    """Files of lenses, of metrics, predictions and frozen losses."""

    lenses: Mapping[LensKey, Path]
    metrics: Mapping[MeasuredKey, Path]
    predictions: Mapping[MeasuredKey, Path] = field(default_factory=dict)
    frozen: Mapping[MeasuredKey, Path] = field(default_factory=dict)

    @classmethod
    def of(cls, contents: Claims | SeededMeasurements, files: MeasurementFiles) -> "Measurements":
        """Return the measurements of claims or tables, from files in the order of their keys."""
        return cls(
            dict(zip(contents.lens_keys, files.lenses, strict=True)),
            dict(zip(contents.measured_keys, files.metrics, strict=True)),
            dict(zip(contents.measured_keys, files.predictions, strict=True)),
        )

    def lens_file(self, lens: str, seed: int) -> dict[str, Any]:
        """Read the content of a lens file; raises FileError if its figures are of another prescription."""
        content = read_yaml(self.lenses[LensKey(lens, seed)])
        lens_digest.check(content, self.lenses[LensKey(lens, seed)])
        return content

    def lens_values(self, lens: str, seed: int) -> dict[str, float]:
        """Apply the function `lens_values` to a lens of the study."""
        return lens_values(self.lens_file(lens, seed))

    def values(self, lens: str, classifier: str, seed: int) -> dict[str, float]:
        """Return each metric, mean over fields."""
        return mean_metrics(self.metrics[MeasuredKey(lens, classifier, seed)])

    def accuracy_by_field(self, lens: str, classifier: str, seed: int) -> dict[str, float]:
        """Return the accuracy [%] at each field by the name of its column in tables by seed."""
        values = accuracy_by_field(self.metrics[MeasuredKey(lens, classifier, seed)])
        return {f"{FIELD}{k}": value for k, value in enumerate(values)}

    def correct(self, lens: str, classifier: str, seed: int, fields: str = "field") -> pandas.DataFrame:
        """Read predictions: 1 if an image is classified correctly, else 0; a row per image, a column per field."""
        return predictions.read(self.predictions[MeasuredKey(lens, classifier, seed)], fields)

    def has(self, fields: str, keys: Iterable[MeasuredKey]) -> bool:
        """Return whether all of these were measured at a set of fields."""
        return all(predictions.has(self.predictions[key], fields) for key in keys)

    def frozen_losses(self, lens: str, classifier: str, seed: int) -> pandas.DataFrame:
        """Read the losses of the frozen classifier: a row per minival image, a column per field; raises FileError."""
        path = self.frozen[MeasuredKey(lens, classifier, seed)]
        frame = read_table(path, dtype={"label": str}, keep_default_na=False)
        try:
            losses = frame.set_index(["image", "label"]).astype(float)
        except (KeyError, ValueError) as error:
            raise damage_error(path, f"no losses of images ({error})") from None
        if losses.empty or losses.isna().any(axis=None):
            raise damage_error(path, "a loss is missing")
        return losses

    def strongest_baseline(self, claim: Claim, seed: int) -> str:
        """Return the baseline of a claim with the best minival accuracy for this seed; "" without baselines.

        The selection is per seed, as a designer selects the best of several designs.
        """
        accuracy = {name: self.values(name, claim.classifier, seed)["minival_accuracy"] for name in claim.baselines}
        return max(accuracy, key=lambda name: accuracy[name], default="")


def least_accuracy(sharp: _Accuracy, chance: float) -> _Accuracy:
    """Return the least accuracy [%] of a design that did not fail: half-way between chance and sharp images."""
    return (sharp + chance) / 2


def has_failed(accuracy: float, sharp: float, chance: float, energy_in_window: float) -> bool:
    """Return whether a design failed: too little energy or, with a fine-tuned classifier, too little accuracy.

    Args:
        accuracy, sharp, chance: accuracy on the captures, on sharp images, and by guessing [%].
    """
    return not (energy_in_window >= LEAST_ENERGY and accuracy >= least_accuracy(sharp, chance))
