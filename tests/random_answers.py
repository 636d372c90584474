"""Random answers to the images of a study, right with a probability of each design."""

from collections.abc import Iterable

import numpy
import pandas

from tasklens.study.claims import Claim
from tasklens.study.report.measurements import Measurements
from tasklens.study.table_contents import MeasuredKey

PROBABILITY = {  # of a correct answer, in the corner half of it
    "imaging2": 0.5,
    "image_psnr": 0.7,
    "image_correlation": 0.8,
    "tasklens": 0.85,
    "tasklens_from_quality": 0.9,
    "tasklens_joint": 0.95,
    "tasklens_joint_from_flat": 0.92,
}


class RandomAnswers(Measurements):
    """Measurements with random answers, right with the probability of the design."""

    def correct(self, lens: str, classifier: str, seed: int, fields: str = "field") -> pandas.DataFrame:
        generator = numpy.random.default_rng([*lens.encode(), seed])
        worth = numpy.array([1.0] if lens == "sharp" else [1.0] * 8 + [0.5])
        answers = generator.random((50, len(worth))) < worth * probability(lens)
        index = pandas.MultiIndex.from_arrays([range(50), ["07"] * 50], names=["image", "label"])
        return pandas.DataFrame(answers.astype(int), index=index)

    def has(self, fields: str, keys: Iterable[MeasuredKey]) -> bool:
        return fields == "field"

    def values(self, lens: str, classifier: str, seed: int) -> dict[str, float]:
        return {"minival_accuracy": 100 * probability(lens), "chance": 10.0, "psnr_db": 20.0}

    def lens_values(self, lens: str, seed: int) -> dict[str, float]:
        return {"energy_in_window": 0.3 if "flat" in lens else 0.9, "rms_spot_um": 3.0}


def probability(lens: str) -> float:
    return PROBABILITY.get(lens.partition("-")[2], 0.5)


def claim(text: str, lens: str, *baselines: str) -> Claim:
    return Claim(table="table3", text=text, lens=lens, baselines=baselines, classifier="small", reference="small")
