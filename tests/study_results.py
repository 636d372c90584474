"""A study for the claims, and result files in which a chosen fraction of the captures through each lens is correct."""

import numpy
import pandas
import yaml
from examples import write
from studies import changed, lens_file, measurement, tiny_study

from tasklens.settings.names import SHARP, measured_name
from tasklens.study.loading import parse
from tasklens.study.study import Study

IMAGES, FIELDS = 200, 9
DOUBLET = ["COC", "OKP4"]


def study_of(seeds: int, **elements) -> Study:
    """A study of two least-squares designs among others, by default of doublets and triplets."""
    plastics = elements or {"doublet": DOUBLET, "triplet": [*DOUBLET, "COC"]}
    designs = tiny_study()["designs"] | {"imaging3": tiny_study()["designs"]["imaging2"]}
    study = tiny_study() | {"elements": plastics, "designs": designs}
    return parse(changed(study, "seeds", list(range(seeds))))


def write_measurement(study: str, lens: str, name: str, seed: int, metrics: dict, **by_image) -> None:
    """Write the files of a measurement.

    Args:
        metrics: values by name: one for each field, or a single number.
        by_image: values (N, F) of the images at each field, by the kind of their file: predictions, frozen.
    """
    rows = []
    for metric, values in metrics.items():
        rows += [(metric, "", values)] if numpy.isscalar(values) else [(metric, k, v) for k, v in enumerate(values)]
    frame = pandas.DataFrame(rows, columns=["metric", "field", "value"])
    write(measurement(study, lens, name, seed), frame.to_csv(index=False))
    for kind, values in by_image.items():
        columns = {f"field{k}": column for k, column in enumerate(numpy.transpose(values))}
        frame = pandas.DataFrame({"image": range(len(values)), "label": "cat"} | columns)
        write(measurement(study, lens, name, seed, f"-{kind}"), frame.to_csv(index=False))


def write_results(study, accuracy, minival=None, inside=0.9, lenses=None) -> None:
    """Write files of a study in which a fraction accuracy(lens, classifier, seed) of all captures is correct.

    One random number per image and field, shared by all lenses, decides: a capture that is correct through a lens is
    also correct through a better one.
    """
    luck = numpy.random.default_rng(0).random((IMAGES, FIELDS))
    for seed in study.seeds:
        for lens in lenses or (SHARP, *study.lenses):
            for name in [*study.classifiers, *(measured_name(name, True) for name in study.classifiers)]:
                fields = 1 if lens == SHARP else FIELDS
                right = (luck[:, :fields] < accuracy(lens, name, seed)).astype(int)
                minival_share = (minival or accuracy)(lens, name, seed)
                metrics = {"minival_accuracy": [100 * minival_share] * fields, "chance": 10.0}
                metrics["accuracy"] = 100 * right.mean(0)
                write_measurement(study.name, lens, name, seed, metrics, predictions=right, frozen=right)
            means = {"rms_spot_um": 9.0, "core_radius_um": 3.0, "energy_in_window": inside}
            text = yaml.safe_dump({"means": means, "worst_margin": {"limit": "max_slope", "value": 0.01}})
            write(lens_file(study.name, lens, seed), text)
