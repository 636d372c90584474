"""Scores of segmentation and detection against counts by hand."""

from dataclasses import replace

import pytest
import torch

from tasklens.recognition.object_tasks import Detections, average_precision, encode, mean_iou


def objects(*corners, scores=None, labels=None):
    """Objects of one image, each a box and the same rectangle as a mask."""
    masks = torch.zeros(len(corners), 80, 80, dtype=torch.bool)
    for mask, (left, top, right, bottom) in zip(masks, corners, strict=True):
        mask[top:bottom, left:right] = True
    boxes = torch.tensor(corners, dtype=torch.float32).reshape(-1, 4)
    scores = None if scores is None else torch.tensor(scores)
    return Detections(boxes, torch.tensor(labels or [0] * len(corners)), scores, encode(masks))


def precision(answers, truths, by):
    """Average precision of objects that have only what is compared: no masks, or empty boxes."""

    def only(one):
        return replace(one, masks=None) if by == "box" else replace(one, boxes=torch.zeros_like(one.boxes))

    return average_precision([only(one) for one in answers], [only(one) for one in truths], 3, by)


def test_mean_iou_by_hand():
    """Two classes and a background: 2 of 3, 1 of 3 and 1 of 2 pixels; a fourth class is nowhere."""
    truth = torch.tensor([0, 0, 1, 1, 2, 2])
    guess = torch.tensor([0, 0, 1, 0, 2, 1])
    assert mean_iou(guess, truth, 4) == pytest.approx(100 * (2 / 3 + 1 / 3 + 1 / 2) / 3)
    assert mean_iou(truth, truth, 4) == 100.0


A, B, OTHER = [0, 0, 10, 10], [20, 20, 40, 40], [60, 60, 70, 70]


@pytest.mark.parametrize(
    "answer, truth, expected",
    [
        (objects(A, B, scores=[0.9, 0.8]), objects(A, B), {"ap": 100, "ap50": 100}),
        (objects(scores=[]), objects(A), {"ap": 0, "ap50": 0}),
        # With recall up to 1/2 the precision is 1: 51 of COCO's 101 recalls.
        (objects(A, scores=[0.9]), objects(A, B), {"ap50": 100 * 51 / 101}),
        # An overlap of 8 of 10 rows is accepted by seven of ten thresholds, 0.50 to 0.80.
        (objects([0, 0, 10, 8], scores=[0.9]), objects(A), {"ap": 70, "ap50": 100}),
        # A false answer before the right one: precision 1/2 everywhere; a false answer after it costs nothing.
        (objects(OTHER, A, scores=[0.9, 0.5]), objects(A), {"ap50": 50}),
        (objects(OTHER, A, scores=[0.1, 0.5]), objects(A), {"ap50": 100}),
        # The mean over classes present: one is right, one is confused with the other.
        (objects(A, B, scores=[0.9, 0.9], labels=[0, 0]), objects(A, B, labels=[0, 1]), {"ap50": 50}),
    ],
)
@pytest.mark.parametrize("by", ["box", "mask"])
def test_average_precision_by_hand(answer, truth, expected, by):
    actual = precision([answer], [truth], by)
    assert actual | expected == pytest.approx(actual)


@pytest.mark.parametrize("by", ["box", "mask"])
def test_objects_are_compared_within_their_image(by):
    answers = [objects(A, scores=[0.9]), objects(scores=[]), objects(B, scores=[0.8])]
    assert precision(answers, [objects(A), objects(OTHER), objects(B)], by)["ap50"] == pytest.approx(100 * 67 / 101)
    assert precision(answers, [objects(B), objects(OTHER), objects(A)], by)["ap50"] == 0
