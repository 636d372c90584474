"""Selection by rule, from the predictions, of the test images that a report shows."""

from collections.abc import Mapping
from pathlib import Path

import pandas

from tasklens.runtime.files import FileError
from tasklens.settings.names import SHARP
from tasklens.show import predictions

_DIVIDING = 2  # number of images that divide the lenses


def choose(files: Mapping[str, Path]) -> list[int]:
    """Choose images from predictions by lens (or SHARP), without human choice.

    Candidates are the test images that are recognised when sharp (if that is measured). The rule takes the first one,
    and the two that divide the lenses most: their share of lenses and fields with a correct answer is the nearest to
    one half. All have different labels.

    Raises:
        FileError: there are no predictions for any lens.
    """
    correct = {lens: predictions.read(path) for lens, path in files.items()}
    sharp = correct.pop(SHARP, None)
    if not correct:
        raise FileError("captures: no lens has been measured yet")
    share = pandas.concat([frame.mean(axis=1) for frame in correct.values()], axis=1).mean(axis=1)
    if sharp is not None and sharp.mean(axis=1).any():
        share = share[sharp.mean(axis=1) > 0]
    order = [share.index[0], *(share - 0.5).abs().sort_values(kind="stable").index]
    images: dict[str, int] = {}
    for image, label in order:
        if len(images) <= _DIVIDING:
            images.setdefault(label, int(image))
    return list(images.values())
