"""Design of one lens from Python, and the verdict on a lens for a task."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

import torch
from torch import nn

from tasklens.api.ranking import Ranking, measure_lenses, on_sharp_images, predictions
from tasklens.design.chain import Designs
from tasklens.design.single import BASELINES, LensRequest, Specification, designs
from tasklens.design.supervision import Loss
from tasklens.fields import SELECTION
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.recognition.dataset import ImageDataset
from tasklens.runtime.errors import InputError
from tasklens.runtime.tensors import explain_errors
from tasklens.settings.lens_settings import TRAINING
from tasklens.show import between_fields
from tasklens.show.bootstrap import interval, resampled_means

_CHOICE = 200  # maximum number of design images used to select the best lens for image quality


@explain_errors
def design_lens(
    method: str | None = None,
    elements: Sequence[str] | None = None,
    *,
    seed: int = 0,
    settings: Mapping[str, Any] | None = None,
    constraints: Mapping[str, Any] | None = None,
    catalogues: str | Path | Sequence[str | Path] = (),
    images: Any = None,
    size: int | None = None,
    network: nn.Module | Mapping[str, Any] | None = None,
    loss: Loss | None = None,
    start: str | Path | tuple[Lens, View] | None = None,
    free: Mapping[str, Sequence[int] | None] | None = None,
    **spec: Unpack[Specification],
) -> tuple[Lens, View, dict[str, Any]]:
    """Design one lens, and before it the lenses that its method starts from.

        lens, view, notes = tasklens.design_lens("least_squares", ["COC", "OKP4"], f_number=2.8)
        tasklens.save_lens("lens.yaml", lens, view, notes)

    A doublet by least squares takes a minute.

    Args:
        method: least_squares, spot, contrast, log_image_error, correlation; with a network task, joint, end_to_end;
            None: least_squares, with `start` spot.
        elements: materials from front to back, by name, built-in or from `catalogues`; None: COC and OKP4.
        seed: seed of all random numbers.
        settings: settings of the method, by the keys of a study file, such as {"evaluations": 2000} or
            {"descents": {"0": {"steps": 200}}}.
        constraints: limits that differ from the defaults of a study, such as {"max_track": 6.0} [mm].
        catalogues: files of further glasses (.agf) or plastics (.yaml).
        images: folder of photographs, <class>/* or train/<class>/*; or a torch dataset, or pairs (image, label); by
            default rendered textures. Of more than 2000 images, 2000 are drawn at random. All of them serve the design
            (the command `tasklens design` keeps a fifth of an unsplit folder apart): rank its lens with others.
        size: side of the photographs of a folder [pixels], by default 224.
        network: trained torch.nn.Module from images (B, 3, H, W) in [0, 1] to logits, or its settings, such as
            {"model": "resnet18", "weights": "resnet.safetensors"}. The images of a timm network are normalised as its
            `pretrained_cfg` says. The methods joint and end_to_end train a module with the lens; all others leave it as
            it is.
        loss: loss(network(captures), labels) instead of cross-entropy: one number, or one per image. Images are not
            augmented unless `settings` has `augment`.
        start: "flat": plane-parallel plates, with the schedule of the studies, instead of imaging lenses. Or the file
            of a lens to improve (.zmx, lens.yaml), or a lens and its view, instead of `elements`. Its glasses
            stay, and limits that it violates are relaxed to its own values.
        free: free variables of `start`, such as {"curvature": [0, 1], "thickness": None}: surfaces numbered from 0, or
            None for all; also alpha_4 .. alpha_10. By default curvatures, distances, and the coefficients of aspheres.
        spec: specification, of which every key may be omitted: f_number, field_of_view_deg, pixel_pitch_um,
            kernel_size, wavelengths_um, by default those of the paper, F/2.8, 68.8 degrees, 1.8 um, 51 pixels, or with
            `start` those of the file; diagonal_mm, aspect of the sensor, by default 4 mm and 16:9, not with `start`;
            object_distance_mm, configuration of the file of `start`, as in `load_lens`.

    Returns:
        The lens, the view (fields, wavelengths, pixels), and notes for its file: spec, origin, figures, margins.

    Raises:
        InputError: a wrong value, an unknown plastic, images that cannot be read, weights that do not fit.
    """
    if unknown := sorted(spec.keys() - Specification.__annotations__.keys()):
        raise TypeError(f"design_lens() got an unexpected keyword argument {unknown[0]!r}")
    if method in TRAINING and isinstance(network, Mapping):
        raise InputError(f"network: {method} trains it with the lens; give a torch.nn.Module, so that you have both")

    def warn(remark: str) -> None:
        where = f"{start}: " if isinstance(start, str | Path) else ""
        warnings.warn(f"{where}{remark}", stacklevel=6)

    request = LensRequest(
        method, elements, seed, settings, constraints, catalogues, images, size, network, loss, start, free, spec
    )
    result = designs(request, remark=warn)
    if result.remark:
        warnings.warn(f"design_lens: {result.remark}", stacklevel=3)
    if result.trained_weights is not None and isinstance(network, nn.Module):
        network.load_state_dict(result.trained_weights)
    return result.lens, result.view, result.notes


def verdict(result: Designs, unused: ImageDataset) -> tuple[str, Ranking]:
    """Compare a lens with the best image-quality lens of the same candidates and effort, on unused images.

    Args:
        result: lenses, images and network of a design with baselines.
        unused: images that no design has used.

    Returns:
        The verdict as text, and the ranking of all lenses.
    """
    supervision = result.supervision
    assert supervision.network is not None and supervision.images is not None  # the design has a network
    *_, name = result.lenses
    lenses = {design: (lens, result.view) for design, lens in result.lenses.items()}
    order = torch.randperm(len(supervision.images), generator=torch.Generator().manual_seed(1))[:_CHOICE]
    of_the_design = on_sharp_images(supervision.network, supervision.images.take(order))
    chosen = {other: predictions(of_the_design, *lenses[other], SELECTION, other)[0] for other in BASELINES}
    best = max(chosen, key=lambda other: chosen[other].to_numpy().mean())
    ranking = measure_lenses(lenses, on_sharp_images(supervision.network, unused))
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
    return " ".join([words, *between_fields.warnings(ranking.correct, ranking.at_nine)]), ranking
