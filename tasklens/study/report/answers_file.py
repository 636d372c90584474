"""The answers behind a table of differences, a bit each: a small file from which its intervals can be recomputed.

Besides the answers it holds the claims that the table tests, and what the choice of baselines and the rule of failure
need: minival accuracies, chance, and the light inside the PSF window.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import BadZipFile

import numpy
import pandas

from tasklens.runtime.files import damage_error, replacing
from tasklens.study.claims import Claims
from tasklens.study.report.measurements import Measurements
from tasklens.study.table_contents import LensKey, MeasuredKey


@dataclass(frozen=True, kw_only=True)
class PackedMeasurements(Measurements):
    """Measurements from one file.

    Attributes:
        answers: correct answers by key, a column per field.
        at_nine: the same at the paper's nine fields, if they were measured there.
        accuracies: minival accuracy and chance by key.
        energy: light in the window by lens and seed.
    """

    answers: Mapping[MeasuredKey, pandas.DataFrame]
    at_nine: Mapping[MeasuredKey, pandas.DataFrame] = field(default_factory=dict)
    accuracies: Mapping[MeasuredKey, Mapping[str, float]]
    energy: Mapping[LensKey, float]

    def correct(self, lens: str, classifier: str, seed: int, fields: str = "field") -> pandas.DataFrame:
        """Return predictions: 1 if an image is classified correctly, else 0; a row per image, a column per field."""
        return {"field": self.answers, "nine": self.at_nine}[fields][MeasuredKey(lens, classifier, seed)]

    def has(self, fields: str, keys: Iterable[MeasuredKey]) -> bool:
        """Return whether all of these were measured at a set of fields."""
        return {*keys} <= {*({"field": self.answers, "nine": self.at_nine}[fields])}

    def values(self, lens: str, classifier: str, seed: int) -> dict[str, float]:
        """Return minival accuracy and chance [%]."""
        return dict(self.accuracies[MeasuredKey(lens, classifier, seed)])

    def lens_values(self, lens: str, seed: int) -> dict[str, float]:
        """Return the share of light inside the PSF window."""
        return {"energy_in_window": self.energy[LensKey(lens, seed)]}


def write(path: Path, claims: Claims, measurements: Measurements) -> None:
    """Write the measurements that claims compare."""
    frames = [measurements.correct(*key) for key in claims.measured_keys]
    at_nine = [
        measurements.correct(*key, "nine") if measurements.has("nine", [key]) else pandas.DataFrame()
        for key in claims.measured_keys
    ]
    values = [measurements.values(*key) for key in claims.measured_keys]
    energy = [measurements.lens_values(*key)["energy_in_window"] for key in claims.lens_keys]
    bits = [frame.to_numpy(bool).ravel() for frame in (*frames, *at_nine)] or [numpy.empty(0, bool)]
    index = frames[0].index.to_frame() if frames else pandas.DataFrame({"image": [], "label": []})
    with replacing(path) as temporary, open(temporary, "wb") as file:
        numpy.savez_compressed(
            file,
            claims=numpy.array(claims.model_dump_json()),
            images=index["image"].to_numpy(numpy.int64),
            labels=index["label"].to_numpy(str),
            fields=numpy.array([frame.shape[1] for frame in frames]),
            nine=numpy.array([frame.shape[1] for frame in at_nine]),
            answers=numpy.packbits(numpy.concatenate(bits)),
            minival_accuracy=numpy.array([row["minival_accuracy"] for row in values]),
            chance=numpy.array([row["chance"] for row in values]),
            energy_in_window=numpy.array(energy),
        )


def read(path: Path) -> tuple[Claims, PackedMeasurements]:
    """Read the claims and the measurements that they compare.

    Raises:
        FileError: the file is damaged.
    """
    try:
        with numpy.load(path, allow_pickle=False) as content:
            arrays = dict(content)
        claims = Claims.model_validate_json(str(arrays["claims"]))
        nine = arrays.get("nine", numpy.zeros_like(arrays["fields"]))
        counts = len(arrays["images"]) * numpy.concatenate([arrays["fields"], nine])  # answers of each measurement
        answers = numpy.unpackbits(arrays["answers"], count=int(counts.sum()))
        parts = numpy.split(answers, numpy.cumsum(counts)[:-1])
        index = pandas.MultiIndex.from_arrays([arrays["images"], arrays["labels"]], names=["image", "label"])
        keys = claims.measured_keys
        frames = [pandas.DataFrame(part.reshape(len(index), -1), index=index) for part in parts if len(part)]
        measured_at_nine = [key for key, count in zip(keys, nine, strict=True) if count]
        rows = zip(arrays["minival_accuracy"].tolist(), arrays["chance"].tolist(), strict=True)
        accuracies = [{"minival_accuracy": accuracy, "chance": chance} for accuracy, chance in rows]
        energy = dict(zip(claims.lens_keys, arrays["energy_in_window"].tolist(), strict=True))
        packed = PackedMeasurements(
            {},
            {},
            answers=dict(zip(keys, frames, strict=False)),  # those at nine fields come last
            at_nine=dict(zip(measured_at_nine, frames[len(keys) :], strict=True)),
            accuracies=dict(zip(keys, accuracies, strict=True)),
            energy=energy,
        )
    except (OSError, EOFError, BadZipFile, ValueError, KeyError) as error:
        raise damage_error(path, f"no packed answers ({error})") from error
    return claims, packed
