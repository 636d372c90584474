"""Evaluation of classifiers on captures."""

import copy
import math

import pytest
import torch
from examples import random_images, trained_network
from torch import nn

from tasklens.camera.imaging import PsfCamera
from tasklens.recognition import dataset as data
from tasklens.recognition import evaluation


class Brightness(nn.Module):
    """Sorts images into dark, medium and bright by their mean."""

    outputs = None  # one output per class

    def forward(self, images):
        return -(images.mean((1, 2, 3))[:, None] - torch.tensor([0.1, 0.5, 0.9])).abs()


def measure(classifier, test, minival, pipeline) -> list[dict]:
    """Metrics of a classifier without training."""
    graded, selected = (evaluation.evaluate(classifier, images, pipeline) for images in (test, minival))
    return evaluation.measure(classifier, test, {"accuracy": graded}, selected, captured=pipeline.camera is not None)


def grey_images(values, labels) -> data.ImageDataset:
    images = torch.tensor(values, dtype=torch.uint8)[:, None, None, None].expand(-1, 3, 16, 16).contiguous()
    return data.ImageDataset(images, torch.tensor(labels), ("dark", "medium", "bright"))


def test_evaluation_against_a_hand_count():
    """Four of five grey images are sorted as labelled; without a camera there is one field and infinite PSNR."""
    dataset = grey_images([10, 130, 240, 20, 120], [0, 1, 2, 2, 1])
    result = evaluation.evaluate(Brightness(), dataset, evaluation.CapturePipeline())
    assert result.correct.tolist() == [[True, True, True, False, True]]
    assert result.psnr_db.shape == (1, 5)
    rows = measure(Brightness(), dataset, dataset.take(torch.tensor([3, 4])), evaluation.CapturePipeline())
    result = {(row["field"], row["metric"]): row["value"] for row in rows}
    assert result.pop((0, "accuracy")) == pytest.approx(80)
    assert result.pop((0, "minival_accuracy")) == pytest.approx(50)
    assert result.pop(("", "chance")) == pytest.approx(100 / 3)
    assert result.pop(("", "parameters_m")) == 0
    assert not result


class Dimming(PsfCamera):
    """A camera whose fields scale the brightness: unlike a lens, but results follow by hand."""

    def __init__(self, factors):
        super().__init__(torch.zeros(len(factors), 3, 3, 3))
        self.factors = torch.tensor(factors)[:, None, None, None, None]

    def all_fields(self, images, generator=None):
        return self.factors * images

    def __call__(self, images, fields, sample=None):
        return self.factors[fields, 0] * images


def test_every_field_is_evaluated_on_every_image():
    """Field 1 halves the light: there 240 is classified as medium, and 120 as dark. 90 images take two batches.

    Losses are those of logits that are minus the distances from 0.1, 0.5 and 0.9.
    """
    dataset = grey_images([10, 240, 120] * 30, [0, 2, 1] * 30)
    result = evaluation.evaluate(Brightness(), dataset, evaluation.CapturePipeline(Dimming([1.0, 0.5])))
    for field, light in enumerate((1.0, 0.5)):
        for image, (grey, label) in enumerate(((10, 0), (240, 2), (120, 1))):
            logits = [-abs(light * grey / 255 - middle) for middle in (0.1, 0.5, 0.9)]
            loss = math.log(sum(map(math.exp, logits))) - logits[label]
            assert result.losses[field, image::3].tolist() == pytest.approx([loss] * 30, rel=1e-5)
    rows = evaluation.by_image({"field": result.losses}, dataset)
    losses = {f"field{field}": result.losses[field, 1].item() for field in (0, 1)}
    assert len(rows) == 90 and rows[1] == {"image": 1, "label": "bright", **losses}
    assert result.correct.shape == (2, 90) and result.psnr_db.shape == (2, 90)
    assert result.correct.double().mean(1).tolist() == pytest.approx([1, 1 / 3])
    expected = -20 * torch.log10(torch.tensor([5, 120, 60]) / 255)
    torch.testing.assert_close(result.psnr_db[1, :3], expected, rtol=0, atol=1e-3)
    rows = measure(Brightness(), dataset, dataset, evaluation.CapturePipeline(Dimming([1.0, 0.5])))
    assert [row["field"] for row in rows if row["metric"] == "psnr_db"] == [0, 1]


def test_restoration_stands_between_camera_and_classifier():
    """A restoration that doubles the light undoes a camera that halves it."""

    class Double(nn.Module):
        def forward(self, captures):
            return 2 * captures

    dataset = grey_images([10, 240, 120], [0, 2, 1])
    pipeline = evaluation.CapturePipeline(Dimming(9 * [0.5]), Double())
    result = evaluation.evaluate(Brightness(), dataset, pipeline)
    assert result.correct.all() and (result.psnr_db > 80).all()
    restored = pipeline.one_field(dataset.batch(torch.arange(3))[0], torch.Generator().manual_seed(0))
    torch.testing.assert_close(restored, dataset.images.float() / 255, rtol=0, atol=1e-6)


def test_the_worst_images_are_one_in_a_hundred():
    """Of 250 images of as many greys, halved in brightness, the three brightest lose most."""
    dataset = grey_images(list(range(1, 251)), [0] * 250)
    rows = measure(Brightness(), dataset, dataset, evaluation.CapturePipeline(Dimming([0.5])))
    psnr = next(row["value"] for row in rows if row["metric"] == "worst_psnr_db")
    expected = -20 * torch.log10(torch.tensor([124.0, 124.5, 125.0]) / 255)
    assert psnr == pytest.approx(float(expected.mean()), abs=1e-3)


def test_evaluation_changes_nothing():
    """Neither batch statistics nor weights move while a classifier is measured."""
    network = trained_network(0)
    before = copy.deepcopy(network.state_dict())
    evaluation.evaluate(network, random_images(20, 16, 3, seed=2), evaluation.CapturePipeline())
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
