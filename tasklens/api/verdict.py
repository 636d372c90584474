"""Verdict on a lens for a task: comparison with the best image-quality lens of the same candidates and effort."""

import torch

from tasklens.api.ranking import Ranking, measured, on_sharp_images, predictions
from tasklens.design.chain import Designs
from tasklens.design.single import BASELINES
from tasklens.fields import SELECTION
from tasklens.recognition.dataset import ImageDataset
from tasklens.show import between_fields
from tasklens.show.bootstrap import interval, resampled_means

_CHOICE = 200  # maximum number of design images used to select the best lens for image quality


def verdict(designs: Designs, unused: ImageDataset) -> tuple[str, Ranking]:
    """Compare a lens with its start and with image-quality lenses, on images that no design has used.

    Args:
        designs: lenses, images and network of a design with baselines.
        unused: images that no design has used.

    Returns:
        The verdict as text, and the ranking of all lenses.
    """
    supervision = designs.supervision
    assert supervision.network is not None and supervision.images is not None  # the design has a network
    *_, name = designs.lenses
    lenses = {design: (lens, designs.view) for design, lens in designs.lenses.items()}
    order = torch.randperm(len(supervision.images), generator=torch.Generator().manual_seed(1))[:_CHOICE]
    of_the_design = on_sharp_images(supervision.network, supervision.images.take(order))
    chosen = {other: predictions(of_the_design, *lenses[other], SELECTION, other)[0] for other in BASELINES}
    best = max(chosen, key=lambda other: chosen[other].to_numpy().mean())
    ranking = measured(lenses, on_sharp_images(supervision.network, unused))
    task, baseline = (100 * ranking.correct[design].mean(axis=1).to_numpy() for design in (name, best))
    low, high = interval(resampled_means((task - baseline)[:, None])[:, 0])
    gain = float((task - baseline).mean())
    answer = "better" if low > 0 else "worse" if high < 0 else "not shown to be better or worse"
    words = (
        f"On {len(unused)} photographs that no design has used, the network recognises {task.mean():.1f} % through "
        f"this lens, and {baseline.mean():.1f} % through the best lens for image quality with the same candidate "
        f"starts and effort ({best}, chosen on photographs of the design): {gain:+.1f} points ({low:+.1f} to "
        f"{high:+.1f}), {answer}. The interval is over the photographs; it is one design of each kind."
    )
    words = " ".join([words, *between_fields.warnings(ranking.correct, ranking.at_nine, "the paper's nine fields")])
    return words, ranking
