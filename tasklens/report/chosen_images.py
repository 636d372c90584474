"""The test images that a report shows, chosen by rule from the predictions."""

from collections.abc import Mapping
from pathlib import Path

import pandas

from tasklens.report import predictions
from tasklens.runtime.files import FileError
from tasklens.study.names import SHARP

_DIVIDING = 2  # images that divide the lenses


def choose(files: Mapping[str, Path]) -> list[int]:
    """Choose images from predictions by lens (or SHARP), without looking at them.

    Of the test images that are recognised sharp (if that is measured): the first one, and two that divide the lenses
    most, those recognised through nearest to half of all lenses and fields. Each has another label.

    Raises:
        FileError: there are no predictions of a lens.
    """
    correct = {lens: predictions.read(path) for lens, path in files.items()}
    sharp = correct.pop(SHARP, None)
    if not correct:
        raise FileError("captures: no lens has been measured yet")
    share = pandas.concat([found.mean(axis=1) for found in correct.values()], axis=1).mean(axis=1)
    if sharp is not None and sharp.mean(axis=1).any():
        share = share[sharp.mean(axis=1) > 0]
    order = [share.index[0], *(share - 0.5).abs().sort_values(kind="stable").index]
    chosen: dict[str, int] = {}
    for image, label in order:
        if len(chosen) <= _DIVIDING:
            chosen.setdefault(label, int(image))
    return list(chosen.values())
