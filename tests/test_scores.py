"""Scores of segmentation and detection against counts by hand and another program."""

import pytest
import torch
from pycocotools import mask

from tasklens.recognition import object_scenes, objects
from tasklens.recognition.scores import Detections, average_precision, encode, mean_iou


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


A, B = [0, 0, 10, 10], [20, 20, 40, 40]


def test_perfect_answers():
    assert average_precision([detections(A, B, scores=[0.9, 0.8])], [truths(A, B)], 1, "box") == {
        "ap": 100.0,
        "ap50": 100.0,
    }


def test_half_of_the_objects():
    """With recall up to 1/2 the precision is 1: 51 of COCO's 101 recalls."""
    only = average_precision([detections(A, scores=[0.9])], [truths(A, B)], 1, "box")
    assert only["ap50"] == pytest.approx(100 * 51 / 101)


def test_overlaps_count_step_by_step():
    """An overlap of 8 of 10 rows: IoU 0.8, accepted by seven of ten thresholds, 0.50 to 0.80."""
    near = average_precision([detections([0, 0, 10, 8], scores=[0.9])], [truths(A)], 1, "box")
    assert near["ap50"] == pytest.approx(100.0) and near["ap"] == pytest.approx(70.0)


def test_false_alarms_cost_where_they_are_surer():
    """A false answer before the right one: precision 1/2 everywhere; a false answer after it costs nothing."""
    other = [60, 60, 70, 70]
    before = average_precision([detections(other, A, scores=[0.9, 0.5])], [truths(A)], 1, "box")
    after = average_precision([detections(other, A, scores=[0.1, 0.5])], [truths(A)], 1, "box")
    assert before["ap50"] == pytest.approx(50.0) and after["ap50"] == pytest.approx(100.0)


def test_classes_are_told_apart():
    """The mean over classes present: one is right, one is confused with the other."""
    answer = [detections(A, B, scores=[0.9, 0.9], labels=[0, 0])]
    assert average_precision(answer, [truths(A, B, labels=[0, 1])], 3, "box")["ap50"] == pytest.approx(50.0)


def test_no_detections_score_zero():
    assert average_precision([detections(scores=[])], [truths(A)], 1, "box") == {"ap": 0.0, "ap50": 0.0}


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
        shifted = torch.stack(
            [m.roll(tuple(torch.randint(-3, 4, (2,), generator=generator).tolist()), (0, 1)) for m in masks]
        )
        visible = torch.rand(len(labels), generator=generator) < 0.8
        other = torch.where(torch.rand(len(labels), generator=generator) < 0.2, (labels + 1) % 10, labels)
        scores = torch.rand(len(labels), generator=generator)
        answers.append(
            Detections(objects.boxes(shifted)[visible], other[visible], scores[visible], encode(shifted[visible]))
        )
    expected = own_average_precision(answers, truths, 0.5, 10, overlap)
    assert average_precision(answers, truths, 10, by)["ap50"] == pytest.approx(expected, abs=1e-6)
    assert 5 < expected < 95
