"""Comparison of the accuracy of a lens at the fields of its design with its accuracy between them."""

from collections.abc import Mapping

import pandas

from tasklens.show import predictions
from tasklens.show.bootstrap import interval, resampled_means


def warnings(
    between: Mapping[str, pandas.DataFrame],
    at_fields: Mapping[str, pandas.DataFrame],
    fields: str = "the paper's nine fields",
) -> list[str]:
    """Return a sentence for each lens that is more accurate at some fields than between them.

    The interval of the difference is over the images, each the mean over its fields.

    Args:
        between: predictions at fields that the design did not see, by lens: a row per image, a column per field.
        at_fields: predictions for the same images at fields that it may have been designed for.
        fields: words for these fields.

    Raises:
        FileError: the images differ.
    """
    sentences = []
    for lens, own in at_fields.items():
        predictions.same_images(own, between[lens], lens)
        rates = [100 * answers.mean(axis=1) for answers in (own, between[lens])]
        excess = (rates[0] - rates[1]).to_numpy()
        low, high = interval(resampled_means(excess[:, None])[:, 0])
        if low > 0:
            sentences.append(
                f"{lens} is fitted to {fields}: {rates[0].mean():.1f} % there, {rates[1].mean():.1f} % between them "
                f"({excess.mean():.1f} points less, {low:.1f} to {high:.1f})."
            )
    return sentences
