"""The way from a picture to a classifier, from the files of a lens."""

from pathlib import Path

import torch

from restoration.nafnet import build
from tasklens.imaging import Camera
from tasklens.recognition.evaluation import Sight
from tasklens.runtime.files import read_tensors
from tasklens.study.settings import Capture, Restoration


def sight(
    capture: Capture | None, restoration: Restoration | None, psf: Path, weights: Path, device: torch.device
) -> Sight:
    """Through the cached PSFs in `psf`, or none, and the trained restoration in `weights`, or none, on a device."""
    camera = network = None
    if capture is not None:
        camera = Camera(read_tensors(psf)[0]["psf"].to(device), capture.outside, capture.colour)
    if restoration is not None:
        network = build(restoration).eval().requires_grad_(False)
        network.load_state_dict(read_tensors(weights)[0])
        network.to(device)
    return Sight(camera, network)
