"""The rendered images of the built-in study."""

import torch

from tasklens.recognition import scenes
from tasklens.settings.image_settings import RENDERED_CLASSES


def test_scenes_are_balanced_and_shuffled():
    images, labels = scenes.render(53, 16, seed=1)
    assert images.shape == (53, 3, 16, 16) and images.dtype == torch.uint8
    counts = torch.bincount(labels, minlength=len(scenes.CLASSES))
    assert counts.max() - counts.min() <= 1 and counts.sum() == 53
    assert not torch.equal(labels, labels.sort().values)


def test_scenes_depend_on_the_seed_only():
    first, again, other = (scenes.render(10, 16, seed) for seed in (5, 5, 6))
    assert torch.equal(first[0], again[0]) and torch.equal(first[1], again[1])
    assert not torch.equal(first[0], other[0])


def test_shorter_periods_have_higher_frequencies():
    """The mean frequency of the textures' power, weighted by it, grows as the periods fall."""

    def frequency(periods):
        images = scenes.render(50, 64, 3, periods)[0].double()
        power = torch.fft.rfft2(images - images.mean((-2, -1), keepdim=True)).abs().square().mean((0, 1))
        radius = torch.hypot(torch.fft.fftfreq(64)[:, None], torch.fft.rfftfreq(64)).double()
        high = radius > 1 / 20  # the ground is soft
        return float((power * radius)[high].sum() / power[high].sum())

    assert frequency((3.5, 8.0)) > 1.3 * frequency((5.0, 16.0)) > 1.3 * frequency((12.0, 16.0))


def test_means_tell_nothing_about_the_class():
    """Brightness and contrast have one distribution: class means differ by no more than chance, F(9, 590) < 3."""
    images, labels = scenes.render(600, 32, seed=2)
    values = images.float() / 255
    for feature in (values.mean((1, 2, 3)), values.mean((2, 3))[:, 0], values.std((1, 2, 3))):
        groups = [feature[labels == k] for k in range(len(scenes.CLASSES))]
        between = sum(len(g) * (g.mean() - feature.mean()) ** 2 for g in groups) / (len(groups) - 1)
        within = sum(((g - g.mean()) ** 2).sum() for g in groups) / (len(feature) - len(groups))
        assert float(between / within) < 3


def test_a_study_knows_how_many_classes_there_are():
    assert len(scenes.CLASSES) == RENDERED_CLASSES
