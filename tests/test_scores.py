"""Scores of segmentation and detection against counts by hand and another program."""

import pytest
import torch
from pycocotools import mask

from tasklens.recognition import object_scenes, objects
from tasklens.recognition.object_tasks import Detections, average_precision, encode, mean_iou


def boxes(*corners):
    return torch.tensor(corners, dtype=torch.float32).reshape(-1, 4)


def truths(*corners, labels=None):
    return Detections(boxes(*corners), torch.tensor(labels or [0] * len(corners)))


def detections(*corners, scores, labels=None):
    return Detections(boxes(*corners), torch.tensor(labels or [0] * len(corners)), torch.tensor(scores))


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
        (detections(A, B, scores=[0.9, 0.8]), truths(A, B), {"ap": 100, "ap50": 100}),
        (detections(scores=[]), truths(A), {"ap": 0, "ap50": 0}),
        # With recall up to 1/2 the precision is 1: 51 of COCO's 101 recalls.
        (detections(A, scores=[0.9]), truths(A, B), {"ap50": 100 * 51 / 101}),
        # An overlap of 8 of 10 rows is accepted by seven of ten thresholds, 0.50 to 0.80.
        (detections([0, 0, 10, 8], scores=[0.9]), truths(A), {"ap": 70, "ap50": 100}),
        # A false answer before the right one: precision 1/2 everywhere; a false answer after it costs nothing.
        (detections(OTHER, A, scores=[0.9, 0.5]), truths(A), {"ap50": 50}),
        (detections(OTHER, A, scores=[0.1, 0.5]), truths(A), {"ap50": 100}),
        # The mean over classes present: one is right, one is confused with the other.
        (detections(A, B, scores=[0.9, 0.9], labels=[0, 0]), truths(A, B, labels=[0, 1]), {"ap50": 50}),
    ],
)
def test_average_precision_by_hand(answer, truth, expected):
    actual = average_precision([answer], [truth], 3, "box")
    assert actual | expected == pytest.approx(actual)


def own_average_precision(answers, truths, threshold, classes, overlap):
    """COCO's definition, reimplemented: greedy matches by score, precision at 101 recalls or more, class mean."""
    values = []
    for label in range(classes):
        total = sum(int((t.labels == label).sum()) for t in truths)
        if not total:
            continue
        pairs = [(i, k) for i, answer in enumerate(answers) for k in (answer.labels == label).nonzero()[:, 0].tolist()]
        every = sorted(((float(answers[i].scores[k]), i, k) for i, k in pairs), reverse=True)
        matched, hits = set(), []
        for _, i, k in every:
            overlaps = [
                (overlap(answers[i], k, truths[i], j), j)
                for j in range(len(truths[i].labels))
                if truths[i].labels[j] == label and (i, j) not in matched
            ]
            best = max(overlaps, default=(0.0, -1))
            hits.append(best[0] >= threshold)
            if hits[-1]:
                matched.add((i, best[1]))
        right, curve = 0, []
        for rank, hit in enumerate(hits, 1):
            right += hit
            curve.append((right / total, right / rank))
        values.append(sum(max((p for r, p in curve if r >= k / 100 - 1e-12), default=0.0) for k in range(101)) / 101)
    return 100 * sum(values) / len(values)


def mask_overlap(answer, k, truth, j):
    one, other = (mask.decode(runs).astype(bool) for runs in (answer.masks[k], truth.masks[j]))
    return float((one & other).sum() / (one | other).sum())


def box_overlap(answer, k, truth, j):
    (a, b, c, d), (e, f, g, h) = answer.boxes[k].tolist(), truth.boxes[j].tolist()
    both = max(0.0, min(c, g) - max(a, e)) * max(0.0, min(d, h) - max(b, f))
    return both / ((c - a) * (d - b) + (g - e) * (h - f) - both)


@pytest.mark.parametrize("by, overlap", [("box", box_overlap), ("mask", mask_overlap)])
def test_scores_of_shifted_scenes_against_another_implementation(by, overlap):
    """Rendered objects, answers shifted by a few pixels, some left out, some of another class."""
    scenes = object_scenes.render(12, 64, 3)
    generator = torch.Generator().manual_seed(0)
    truths, answers = [], []
    for image in range(12):
        labels, masks = scenes.objects_of(image)
        truths.append(Detections(objects.boxes(masks), labels, None, encode(masks)))
        shifts = torch.randint(-3, 4, (len(masks), 2), generator=generator).tolist()
        shifted = torch.stack([m.roll(shift, (0, 1)) for m, shift in zip(masks, shifts, strict=True)])
        visible = torch.rand(len(labels), generator=generator) < 0.8
        other = torch.where(torch.rand(len(labels), generator=generator) < 0.2, (labels + 1) % 10, labels)
        scores = torch.rand(len(labels), generator=generator)
        seen = shifted[visible]
        answers.append(Detections(objects.boxes(seen), other[visible], scores[visible], encode(seen)))
    expected = own_average_precision(answers, truths, 0.5, 10, overlap)
    assert average_precision(answers, truths, 10, by)["ap50"] == pytest.approx(expected, abs=1e-6)
    assert 5 < expected < 95
