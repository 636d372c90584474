"""Training of the restoration network on the captures of a lens."""

from restoration import training
from tasklens.imaging import Camera
from tasklens.optics.io import psf_files
from tasklens.recognition import dataset
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import Files, write_rows, write_tensors
from tasklens.study.settings import Slice


def run(settings: Slice, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write the weights, and the history of the training."""
    device = claim()
    camera = Camera.of(settings.capture, *(tensor.to(device) for tensor in psf_files.read(inputs.psf)))
    train, minival = (dataset.read(*inputs.images[name], device=device) for name in ("train", "minival"))
    network, history = training.train(settings.restoration, train, minival, camera, settings.seed, checkpoint)
    write_rows(outputs.history, history)
    write_tensors(outputs.weights, network.state_dict(), {})
