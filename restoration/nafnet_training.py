"""Training of the restoration network on the captures of one lens."""

import math
from typing import Any

import torch
from torch import Tensor

from restoration.nafnet import NAFNet
from tasklens.camera.imaging import psnr
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.recognition.training import Shuffled, warmup_cosine
from tasklens.runtime.checkpoints import NO_CHECKPOINT, Checkpoint
from tasklens.runtime.progress import Progress
from tasklens.settings.network_settings import RestorationSettings

_VALIDATION_IMAGES = 64  # number of minival images, each at every field
_WARMUP = 0.05  # fraction of the steps
_BETAS = (0.9, 0.9)  # betas of AdamW, as in NAFNet
_GRADIENT_NORM = 0.01  # largest gradient norm, as in NAFNet


def train(
    settings: RestorationSettings,
    dataset: ImageDataset,
    minival: ImageDataset,
    pipeline: CapturePipeline,
    validation_pipeline: CapturePipeline,
    seed: int,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> tuple[NAFNet, list[dict[str, Any]]]:
    """Train a NAFNet to restore captures, each at a random field, to their sharp images.

    The loss is the negative PSNR of each image; the optimizer is AdamW with betas (0.9, 0.9) and gradients clipped at a
    norm of 0.01, as in NAFNet. The learning rate rises for 5 % of the steps and falls along a cosine to zero.

    Args:
        settings: network, learning rate, number of steps, and side of the crops.
        dataset, minival: sharp images for training and for validation.
        pipeline: capture pipeline of the lens at the fields of training.
        validation_pipeline: the same at the fields of the selection.
        seed: seed of the network, the image order, the fields and the crops.
        checkpoint: checkpoint of the job; the part is `restoration`.

    Returns:
        The network, in `eval()`; and a row every `settings.check` steps and at the last step: step, learning rate, and
        mean PSNR of 64 minival images at all fields [dB].

    Raises:
        FloatingPointError: the PSNR is not finite.
    """
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    network = NAFNet(settings).to(dataset.device)
    optimizer = torch.optim.AdamW(network.parameters(), settings.learning_rate, _BETAS, weight_decay=0.0, fused=True)
    schedule = warmup_cosine(optimizer, settings.steps, _WARMUP)
    progress = Progress("restoration", settings.steps)
    order = Shuffled(len(dataset), settings.batch_size, generator)
    part = checkpoint.part("restoration", network=network, optimizer=optimizer, schedule=schedule, order=order)
    for step in range(part.step + 1, settings.steps + 1):
        images, _ = dataset.batch(order.next())
        pairs = torch.stack([pipeline.one_field(images, generator), images])
        captures, sharp = _crop(pairs, settings.crop, generator)
        quality = psnr(network(captures), sharp).mean()
        _check_finite("PSNR", quality.item(), step)
        optimizer.zero_grad()
        (-quality).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), _GRADIENT_NORM)
        optimizer.step()
        progress(step, psnr_db=quality.item())
        if step % settings.check == 0 or step == settings.steps:
            validation_psnr = _validation_psnr(network, minival, validation_pipeline)
            _check_finite("PSNR of the minival", validation_psnr, step)
            rate = schedule.get_last_lr()[0]
            part.history.append({"step": step, "learning_rate": rate, "psnr_db": validation_psnr})
        schedule.step()
        part.save(step)
    return network.eval(), part.history


def _crop(images: Tensor, side: int | None, generator: torch.Generator) -> Tensor:
    """Return the same random square crop of images (..., H, W); whole images if `side` is None or not smaller."""
    height, width = images.shape[-2:]
    if side is None or side >= min(height, width):
        return images
    top, left = (int(torch.randint(length - side + 1, (), generator=generator)) for length in (height, width))
    return images[..., top : top + side, left : left + side]


def _check_finite(name: str, value: float, step: int) -> None:
    if not math.isfinite(value):
        raise FloatingPointError(f"restoration: {name} = {value} at step {step}; lower restoration.learning_rate")


@torch.no_grad()
def _validation_psnr(network: NAFNet, minival: ImageDataset, pipeline: CapturePipeline) -> float:
    """Compute the mean PSNR [dB] over images and fields."""
    images, _ = minival.batch(torch.arange(min(_VALIDATION_IMAGES, len(minival))))
    captures = pipeline.all_fields(images)
    return float(torch.stack([psnr(network(at_field), images).mean() for at_field in captures]).mean())
