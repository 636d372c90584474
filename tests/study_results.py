"""A study for the claims, and result files in which a chosen fraction of the captures through each lens is correct."""

import numpy
import pandas
import yaml
from examples import changed, lens_file, measurement, tiny_study, write

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


def write_results(study, accuracy, minival=None, inside=0.9, lenses=None) -> None:
    """Write files of a study in which a fraction accuracy(lens, classifier, seed) of all captures is correct.

    One random number per image and field, shared by all lenses, decides: a capture that is correct through a lens is
    also correct through a better one.
    """
    luck = numpy.random.default_rng(0).random((IMAGES, FIELDS))
    index = {"image": range(IMAGES), "label": ["cat"] * IMAGES}
    for seed in study.seeds:
        for lens in lenses or (SHARP, *study.lenses):
            for name in [*study.classifiers, *(measured_name(name, True) for name in study.classifiers)]:
                fields = 1 if lens == SHARP else FIELDS
                right = (luck[:, :fields] < accuracy(lens, name, seed)).astype(int)
                minival_share = (minival or accuracy)(lens, name, seed)
                columns = {f"field{k}": right[:, k] for k in range(fields)}
                for kind in ("-predictions", "-frozen"):
                    path = measurement(study.name, lens, name, seed, kind)
                    write(path, pandas.DataFrame(index | columns).to_csv(index=False))
                rows = [("minival_accuracy", k, 100 * minival_share) for k in range(fields)] + [("chance", "", 10.0)]
                rows += [("accuracy", k, value) for k, value in enumerate(100 * right.mean(0))]
                frame = pandas.DataFrame(rows, columns=["metric", "field", "value"])
                write(measurement(study.name, lens, name, seed), frame.to_csv(index=False))
            means = {"rms_spot_um": 9.0, "core_radius_um": 3.0, "energy_in_window": inside}
            text = yaml.safe_dump({"means": means, "worst_margin": {"limit": "max_slope", "value": 0.01}})
            write(lens_file(study.name, lens, seed), text)
