"""Random answers to the images of a study, right with a probability of each design."""

import numpy
import pandas

from tasklens.settings.names import SHARP
from tasklens.study.claims import Claim, Claims
from tasklens.study.report.answers_file import PackedMeasurements

PROBABILITY = {  # of a correct answer, in the corner half of it
    "imaging2": 0.5,
    "image_psnr": 0.7,
    "image_correlation": 0.8,
    "tasklens": 0.85,
    "tasklens_from_quality": 0.9,
    "tasklens_joint": 0.95,
    "tasklens_joint_from_flat": 0.92,
}


def random_answers(claims: Claims) -> PackedMeasurements:
    """Measurements with random answers, right with the probability of the design."""
    index = pandas.MultiIndex.from_arrays([range(50), ["07"] * 50], names=["image", "label"])
    answers, accuracies = {}, {}
    for key in claims.measured_keys:
        worth = numpy.array([1.0] if key.lens == SHARP else [1.0] * 8 + [0.5])
        luck = numpy.random.default_rng([*key.lens.encode(), key.seed]).random((50, len(worth)))
        answers[key] = pandas.DataFrame((luck < worth * probability(key.lens)).astype(int), index)
        accuracies[key] = {"minival_accuracy": 100 * probability(key.lens), "chance": 10.0}
    energy = {key: 0.3 if "flat" in key.lens else 0.9 for key in claims.lens_keys}
    return PackedMeasurements({}, {}, answers=answers, accuracies=accuracies, energy=energy)


def probability(lens: str) -> float:
    return PROBABILITY.get(lens.partition("-")[2], 0.5)


def claim(text: str, lens: str, *baselines: str) -> Claim:
    return Claim(table="table3", text=text, lens=lens, baselines=baselines, classifier="small", reference="small")
