"""Training of the restoration network on the captures of a lens."""

from restoration import training
from tasklens.imaging import Camera
from tasklens.recognition import dataset
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.devices import claim
from tasklens.runtime.files import Files, read_tensors, write_rows, write_tensors
from tasklens.study.settings import Slice


def run(settings: Slice, inputs: Files, outputs: Files, checkpoint: Checkpoint) -> None:
    """Write the weights, and the history of the training."""
    device, capture = claim(), settings.capture
    tensors = {name: tensor.to(device) for name, tensor in read_tensors(inputs.psf)[0].items()}
    camera = Camera(tensors["psf"], capture.outside_window, capture.colour, capture.sensor, tensors["illumination"])
    train, minival = (dataset.read(*inputs.images[name], device=device) for name in ("train", "minival"))
    network, history = training.train(settings.restoration, train, minival, camera, settings.seed, checkpoint)
    write_rows(outputs.history, history)
    write_tensors(outputs.weights, network.state_dict(), {})
