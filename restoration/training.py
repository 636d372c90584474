"""Training of the restoration network on the captures of one lens until convergence."""

import copy
import math
import sys
from typing import Any

import torch
from torch import Tensor
from torch.optim.lr_scheduler import ReduceLROnPlateau

from restoration.nafnet import NAFNet, build
from tasklens.imaging import PsfCamera, noise, psnr
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.training import Shuffled
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.progress import Progress
from tasklens.study.settings import RestorationSettings

_VALIDATION_IMAGES = 64  # minival images, each at every field
_GAIN_DB = 0.1  # least gain over the best PSNR at a check that counts as progress
_DROP = 0.1  # factor on the learning rate at the first check without progress; the second one ends the training


def train(
    settings: RestorationSettings,
    dataset: ImageDataset,
    minival: ImageDataset,
    camera: PsfCamera,
    seed: int,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> tuple[NAFNet, list[dict[str, Any]]]:
    """Train a NAFNet to restore captures of `camera`, each at a random field, to their sharp images.

    The loss is the negative PSNR of each image; the optimizer is AdamW with betas (0.9, 0.9) and gradients clipped at a
    norm of 0.01, as NAFNet's authors do. Every `settings.check` steps the mean PSNR of 64 minival images at all fields
    is computed. If it is not 0.1 dB above the last check with progress, the learning rate drops to a tenth; at the
    second such check the training has converged.

    Args:
        settings: network, learning rate, and maximum number of steps.
        dataset, minival: sharp images for training and for validation.
        camera: camera with the PSFs of the lens.
        seed: seed of the network, the image order and the fields.
        checkpoint: checkpoint of the job; the part is `restoration`.

    Returns:
        The network of the best check, in `eval()`; and a row per check: step, learning rate, PSNR [dB], and whether the
        training has converged.

    Raises:
        FloatingPointError: the PSNR is not finite.
    """
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    network = build(settings).to(dataset.device)
    betas = (0.9, 0.9)
    optimizer = torch.optim.AdamW(network.parameters(), settings.learning_rate, betas, weight_decay=0.0, fused=True)
    plateau = ReduceLROnPlateau(optimizer, "max", _DROP, patience=0, threshold=_GAIN_DB, threshold_mode="abs")
    progress = Progress("restoration", settings.steps)
    order = Shuffled(len(dataset), settings.batch_size, generator)
    best, found = -torch.inf, {}
    part = checkpoint.part("restoration", network=network, optimizer=optimizer, plateau=plateau, order=order)
    if part.state is not None:
        best, found = part.state["best"], part.state["found"]
    for step in range(part.step + 1, settings.steps + 1):
        images, _ = dataset.batch(order.next())
        fields = torch.randint(len(camera.psf), (len(images),), generator=generator)
        drawn = None if camera.sensor is None else noise(images.shape, generator)
        quality = _step(network, optimizer, camera.single(images, fields, drawn), images)
        if not math.isfinite(quality):
            raise FloatingPointError(f"restoration: the PSNR became {quality} at step {step}; lower its learning_rate")
        progress(step, psnr_db=quality)
        if step % settings.check == 0 or step == settings.steps:
            validated = _validation_psnr(network, minival, camera)
            if not math.isfinite(validated):
                raise FloatingPointError(
                    f"restoration: the minival's PSNR became {validated} at step {step}; lower its learning_rate"
                )
            if validated > best:
                best, found = validated, copy.deepcopy(network.state_dict())
            rate = optimizer.param_groups[0]["lr"]
            plateau.step(validated)
            converged = optimizer.param_groups[0]["lr"] < settings.learning_rate * _DROP
            part.history.append({"step": step, "learning_rate": rate, "psnr_db": validated, "converged": converged})
            if converged:
                break
        part.save(step, best=best, found=found)
    if not part.history[-1]["converged"]:
        print(f"restoration: not converged within {settings.steps} steps", file=sys.stderr, flush=True)
    network.load_state_dict(found)
    return network.eval(), part.history


def _step(network: NAFNet, optimizer: torch.optim.Optimizer, captures: Tensor, images: Tensor) -> float:
    """Return the mean PSNR [dB] of restored captures (B, 3, H, W), and take a step if it is finite."""
    quality = psnr(network(captures), images).mean()
    if torch.isfinite(quality):
        optimizer.zero_grad()
        (-quality).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 0.01)
        optimizer.step()
    return quality.item()


@torch.no_grad()
def _validation_psnr(network: NAFNet, minival: ImageDataset, camera: PsfCamera) -> float:
    """Compute the mean PSNR [dB] over images and fields."""
    images, _ = minival.batch(torch.arange(min(_VALIDATION_IMAGES, len(minival))))
    return float(torch.stack([psnr(network(captures), images).mean() for captures in camera.grid(images)]).mean())
