"""NAFNet and its training."""

import pytest
import torch
from examples import random_images

from restoration import nafnet_training
from restoration.nafnet import NAFNet
from tasklens.camera.imaging import PsfCamera, psnr
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.settings.network_settings import RestorationSettings


def small(seed: int = 0) -> NAFNet:
    torch.manual_seed(seed)
    return NAFNet(RestorationSettings(steps=1, width=4, encoder=(1, 2), middle=1, decoder=(1, 1)))


def images(seed: int, *shape) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def test_paper_size_has_the_papers_parameters():
    """Width 32, encoder 1 1 1 8, middle 1, decoder 1 1 1 1: 7 767 907 parameters, as the original's code counts."""
    network = NAFNet(RestorationSettings(steps=1))
    assert sum(p.numel() for p in network.parameters()) == 7_767_907


def test_network_adds_a_correction_to_its_input():
    """With a silent last layer nothing is added; otherwise output - input is what the last layer says."""
    network, x = small(), images(1, 2, 3, 16, 20)
    assert not torch.equal(network(x), x)
    torch.nn.init.zeros_(network.ending.weight)
    torch.nn.init.constant_(network.ending.bias, 0.25)
    torch.testing.assert_close(network(x), x + 0.25, rtol=0, atol=1e-7)


@pytest.mark.parametrize("size", [(18, 16), (16, 30)])
def test_wrong_size_is_refused(size):
    with pytest.raises(ValueError, match=rf"{size[0]} x {size[1]}.*multiples of 4"):
        small()(torch.zeros(1, 3, *size))


def blurred() -> PsfCamera:
    """Nine fields, blurred by one pixel to each side."""
    grid = torch.zeros(9, 3, 5, 5)
    grid[..., 1:4, 1:4] = 1 / 9
    return PsfCamera(grid)


PIPELINES = CapturePipeline(blurred()), CapturePipeline(blurred())  # of training and validation
TINY = RestorationSettings(width=8, encoder=(1,), middle=1, decoder=(1,), steps=60, batch_size=8, learning_rate=5e-3)


def test_training_restores_and_is_deterministic():
    """Sixty steps raise the PSNR of captures blurred by one pixel to each side; one seed, one result."""
    sharp, minival = random_images(16, 16, 2, seed=0), random_images(8, 16, 2, seed=1)
    network, _ = nafnet_training.train(TINY, sharp, minival, *PIPELINES, 0)
    assert not network.training
    images, _ = sharp.batch(torch.arange(16))
    captures = blurred()(images, torch.zeros(16, dtype=torch.long))
    with torch.no_grad():
        gain = (psnr(network(captures), images) - psnr(captures, images)).mean()
    assert gain > 0.5
    short = TINY.model_copy(update={"steps": 2})
    states = (nafnet_training.train(short, sharp, minival, *PIPELINES, seed)[0].state_dict() for seed in (0, 0, 1))
    first, again, other = states
    assert all(torch.equal(first[k], again[k]) for k in first)
    assert any(not torch.equal(first[k], other[k]) for k in first)


def test_learning_rate_falls_to_zero_and_the_last_network_is_returned():
    """Rows at every check and at the end; the PSNR of the last one is that of the network."""
    sharp, minival = random_images(16, 16, 2, seed=0), random_images(8, 16, 2, seed=1)
    settings = TINY.model_copy(update={"steps": 25, "check": 10})
    network, history = nafnet_training.train(settings, sharp, minival, *PIPELINES, 0)
    assert [row["step"] for row in history] == [10, 20, 25]
    rates = [row["learning_rate"] for row in history]
    assert rates == sorted(rates, reverse=True) and max(rates) < TINY.learning_rate
    assert rates[-1] < 0.01 * TINY.learning_rate
    images, _ = minival.batch(torch.arange(8))
    with torch.no_grad():
        again = [float(psnr(network(captures), images).mean()) for captures in blurred().all_fields(images)]
    assert sum(again) / 9 == pytest.approx(history[-1]["psnr_db"], abs=1e-5)


def test_crops_train_a_network_for_whole_captures():
    """Captures and images are cut alike, and a crop as large as the image is the image."""
    sharp, minival = random_images(16, 32, 2, seed=0), random_images(8, 32, 2, seed=1)
    images, _ = minival.batch(torch.arange(8))
    captures = blurred()(images, torch.zeros(8, dtype=torch.long))
    before = psnr(captures, images).mean()
    cropped = TINY.model_copy(update={"crop": 16, "steps": 120})
    _, history = nafnet_training.train(cropped, sharp, minival, *PIPELINES, 0)
    assert history[-1]["psnr_db"] > before + 0.5
    whole, cut = (
        nafnet_training.train(TINY.model_copy(update={"steps": 2, "crop": crop}), sharp, minival, *PIPELINES, 0)[1]
        for crop in (None, 32)
    )
    assert whole == cut


def test_a_crop_that_the_levels_cannot_halve_is_refused():
    with pytest.raises(ValueError, match=r"crop = 30: expected a multiple of 4 for 2 levels"):
        RestorationSettings(steps=1, encoder=(1, 1), decoder=(1, 1), crop=30)
