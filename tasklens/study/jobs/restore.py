"""Training of the restoration network on the captures of a lens."""

from collections.abc import Sequence
from pathlib import Path

from restoration import nafnet_training
from tasklens.recognition import dataset
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import write_rows, write_tensors
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.network_settings import RestorationSettings


def run(
    restoration: RestorationSettings,
    capture: CaptureSettings,
    seed: int,
    train: Sequence[Path],
    minival: Sequence[Path],
    psf: Path,
    weights: Path,
    history: Path,
    checkpoint: Checkpoint,
) -> None:
    """Write the weights and the training history."""
    device = claim()
    pipeline, of_validation = (CapturePipeline.of(capture, psf, fields, device) for fields in ("training", "selection"))
    images, selection = (dataset.read(*split, device=device) for split in (train, minival))
    network, rows = nafnet_training.train(restoration, images, selection, pipeline, of_validation, seed, checkpoint)
    write_rows(history, rows)
    write_tensors(weights, network.state_dict(), {})
