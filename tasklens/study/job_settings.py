"""Settings of each kind of job: the part of a study that it reads; no torch here.

Snakemake compares them, so that a changed value reruns the jobs that read it, and no others. `of` takes them from the
study and the wildcards of the rule; other rules name the values.
"""

import os
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from tasklens.settings import names
from tasklens.settings.base import Frozen
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.field_settings import Points
from tasklens.settings.names import SHARP
from tasklens.settings.network_settings import ClassifierSettings, RestorationSettings, TrainingSettings
from tasklens.settings.specification import Spec
from tasklens.study.study import Study, StudyError


def folder_digest(folder: Path) -> str:
    """Return the digest of names, sizes and modification times of all files below a folder, which may be absent."""
    entries, seen = [], set()
    for root, folders, files in os.walk(folder, followlinks=True):
        status = os.stat(root)
        if (status.st_dev, status.st_ino) in seen:  # a link to an enclosing folder would never end
            folders.clear()
            continue
        seen.add((status.st_dev, status.st_ino))
        folders.sort()
        for name in sorted(files):
            path = os.path.join(root, name)
            status = os.stat(path) if os.path.exists(path) else os.lstat(path)  # a broken link
            entries.append(f"{os.path.relpath(path, folder)} {status.st_size} {status.st_mtime_ns}")
    return sha256("\n".join(entries).encode()).hexdigest()[:16]


@cache  # list a million photographs only once
def source(folder: Path | None) -> str | None:
    """Return the digest of a folder of images; None without a folder."""
    return None if folder is None else folder_digest(folder)


class PsfJob(Frozen):
    """PSFs of a lens.

    Attributes:
        diffraction: whether they include diffraction.
        sensor: whether captures have a sensor, which needs the relative illumination.
        sets: fields by set and turn, fractions of the sensor; None: drawn uniformly in area.
        seed: seed of the fields that are drawn.
    """

    spec: Spec
    rays: int
    diffraction: bool
    sensor: bool
    sets: dict[str, tuple[Points, ...] | None]
    seed: int

    @classmethod
    def of(cls, study: Study, lens: str, seed: int) -> "PsfJob":
        """Return the settings of the job."""
        return cls(
            spec=study.lens_spec(lens),
            rays=study.evaluation_rays,
            diffraction=study.capture_of(lens).diffraction,
            sensor=study.capture_of(lens).sensor is not None,
            sets=study.fields.sets(study.design_points(lens)),
            seed=seed,
        )


class CapturePipelineSettings(Frozen):
    """Settings of a classifier's input: captures of a lens (None: sharp images), restored or not (None)."""

    capture: CaptureSettings | None
    restoration: RestorationSettings | None


def _pipeline(study: Study, lens: str, restored: bool) -> dict[str, Any]:
    if restored and lens == SHARP:
        raise StudyError(f"{SHARP} images are not restored; expected a classifier without -restored")
    return {
        "capture": None if lens == SHARP else study.capture_of(lens),
        "restoration": study.restoration if restored else None,
    }


def lens_columns(study: Study, lens: str) -> dict[str, Any]:
    """Return the columns that identify a lens, or the sharp images, in tables."""
    if lens == SHARP:
        return {"elements": "", "design": "reference"}
    entry = study.lens(lens)
    return {"elements": entry.elements, "design": entry.design_name}


class FineTuningJob(CapturePipelineSettings):
    """Fine-tuning of a classifier on captures, and its measurement.

    Attributes:
        graded: sets of fields of the test images, by the metric of their accuracy.
        columns: identify its rows in tables.
    """

    graded: dict[str, str]
    classifier: ClassifierSettings
    training: TrainingSettings
    columns: dict[str, Any]
    seed: int

    @classmethod
    def of(cls, study: Study, lens: str, measured_name: str, seed: int) -> "FineTuningJob":
        """Return the settings of the job."""
        name, restored = names.split(measured_name)
        keys = {"classifier": name, "restored": restored, "seed": seed}
        return cls(
            **_pipeline(study, lens, restored),
            graded={"accuracy": "grading"} if lens == SHARP else study.fields.grading_sets(study.design_points(lens)),
            classifier=study.classifier(name),
            training=study.fine_tuning,
            columns=lens_columns(study, lens) | keys,
            seed=seed,
        )


class ReproductionJob(CapturePipelineSettings):
    """Classification of the test images with the stored weights of a classifier."""

    classifier: ClassifierSettings

    @classmethod
    def of(cls, study: Study, lens: str, measured_name: str) -> "ReproductionJob":
        """Return the settings of the job."""
        name, restored = names.split(measured_name)
        return cls(**_pipeline(study, lens, restored), classifier=study.classifier(name))
