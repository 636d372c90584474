"""Training of the restoration network on the captures of one lens."""

import torch
from torch.optim.lr_scheduler import CosineAnnealingLR

from restoration.nafnet import NAFNet
from tasklens.imaging import Camera, psnr
from tasklens.progress import Progress
from tasklens.recognition.data import Pictures
from tasklens.recognition.training import shuffled
from tasklens.settings import Restoration


def build(settings: Restoration) -> NAFNet:
    """The untrained network that `settings` describe."""
    return NAFNet(settings.width, settings.encoder, settings.middle, settings.decoder)


def train(settings: Restoration, pictures: Pictures, camera: Camera, seed: int) -> NAFNet:
    """A NAFNet that restores captures of `camera`, each at a random field, to their sharp pictures.

    The loss is the negative PSNR of each image; AdamW with betas (0.9, 0.9), cosine to 1e-7 and gradients clipped at
    a norm of 0.01, as the authors of NAFNet train it.
    """
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    network = build(settings)
    optimizer = torch.optim.AdamW(network.parameters(), lr=settings.rate, betas=(0.9, 0.9), weight_decay=0.0)
    schedule = CosineAnnealingLR(optimizer, settings.steps, eta_min=1e-7)
    progress = Progress("restoration", settings.steps)
    for step, indices in enumerate(shuffled(len(pictures), settings.batch, settings.steps, generator), 1):
        images, _ = pictures.batch(indices)
        fields = torch.randint(len(camera.psf), (len(images),), generator=generator)
        quality = psnr(network(camera.single(images, fields)), images).mean()
        if not torch.isfinite(quality):
            raise FloatingPointError(f"restoration: the PSNR became {quality.item()} at step {step}")
        optimizer.zero_grad()
        (-quality).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 0.01)
        optimizer.step()
        schedule.step()
        progress(step, psnr_db=quality.item())
    return network.eval()
