"""Training of the restoration network on the captures of a lens."""

from collections.abc import Sequence
from pathlib import Path

from restoration import training
from tasklens.imaging import PsfCamera
from tasklens.optics.io import psf_files
from tasklens.recognition import dataset
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import write_rows, write_tensors
from tasklens.study.job_settings import RestorationJob


def run(
    settings: RestorationJob,
    train: Sequence[Path],
    minival: Sequence[Path],
    psf: Path,
    weights: Path,
    history: Path,
    checkpoint: Checkpoint,
) -> None:
    """Write the weights and the training history."""
    device = claim()
    camera, validation_camera = (
        PsfCamera.of(settings.capture, *(tensor.to(device) for tensor in psf_files.read(psf, fields)))
        for fields in ("training", "selection")
    )
    images, selection = (dataset.read(*split, device=device) for split in (train, minival))
    splits = images, selection
    cameras = camera, validation_camera
    network, rows = training.train(settings.restoration, *splits, *cameras, settings.seed, checkpoint)
    write_rows(history, rows)
    write_tensors(weights, network.state_dict(), {})
