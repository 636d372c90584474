"""Ranking of lenses for a network: accuracies on the same photographs, with intervals and groups."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from math import atan, degrees
from pathlib import Path
from typing import Any

import pandas
import torch
from timm.data import ImageNetInfo
from torch import Tensor, nn

from tasklens.api.captures import check_light
from tasklens.camera.imaging import PsfCamera
from tasklens.fields import GRADING, GRADING_CENTRES, PAPER, Points
from tasklens.optics.analysis.datasheet import means
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.lens import Lens
from tasklens.optics.psf import energy_inside, window_remark
from tasklens.optics.view import View
from tasklens.recognition import classifiers, evaluation, pairs
from tasklens.recognition.classifiers import Classifier
from tasklens.recognition.dataset import PHOTOGRAPH_SIZE, ImageDataset, test_images
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.recognition.sharp import TooFewImages, better_than_guessing
from tasklens.runtime.devices import CPU
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import as_path, write_text
from tasklens.runtime.tensors import explain_errors
from tasklens.show import between_fields, headings
from tasklens.show import lens_ranks as report
from tasklens.show.figures import section_svg

_RAYS = 4096  # rays of each field and colour


@dataclass(frozen=True)
class Ranking:
    """Lenses in order of a network's accuracy through them; a notebook displays the ranking.

    Attributes:
        table: a row for each lens.
        correct: by lens, 1 if an image is classified correctly, else 0; a row per image, a column per field.
        at_nine: the same at the paper's nine fields.
        drawings: cross-sections by lens, as SVG.
        sharp: accuracy on the sharp images [%].
    """

    table: pandas.DataFrame
    correct: Mapping[str, pandas.DataFrame]
    at_nine: Mapping[str, pandas.DataFrame]
    drawings: Mapping[str, str]
    sharp: float

    @property
    def sentences(self) -> list[str]:
        """Sentences that name the lenses with equal accuracy, and the deficit of the others."""
        return report.sentences(self.table)

    def save(self, path: str | Path, title: str = "Which lens for this network?", answer: Sequence[str] = ()) -> None:
        """Write the ranking as one HTML file; the sentences in `answer` come first."""
        texts: dict[str, Any] = {"title": title, "images": len(next(iter(self.correct.values()))), "sharp": self.sharp}
        texts |= {"tuned": ", as it is", "left_out": {}, "grade": ""}
        page = report.render(self.table, {}, self.correct, self.drawings, [*answer, *self.sentences], **texts)
        write_text(as_path(path, "path"), page)

    def __repr__(self) -> str:
        return headings.texts(self.table).to_string(index=False)

    def _repr_html_(self) -> str:
        table = headings.texts(self.table).to_html(index=False)
        return "".join(f"<p>{escape(sentence)}</p>" for sentence in self.sentences) + table


@explain_errors
def rank(
    lenses: Mapping[str, tuple[Lens, View]],
    images: Any,
    network: nn.Module,
    *,
    size: int | None = None,
    outputs: str = "classes",
    max_images: int = 500,
    rays: int = _RAYS,
) -> Ranking:
    """Rank lenses by the accuracy of a network through each, at 64 fields uniform in area over its sensor.

    Each image is captured at 16 of them, one in each of 4 x 4 cells. A lens that is more accurate at the nine fields of
    the paper, for which many lenses are designed, gets a warning.

    Args:
        lenses: lenses with their views, by name: {"mine": tasklens.load_lens("mine.zmx")}.
        images: folder of photographs, test/<class>/* or <class>/*; or a torch data set, or pairs (image, label).
        network: a module from images (B, 3, H, W) in [0, 1] to logits, on a GPU if its parameters are there. The
            images of a timm network are normalised as its `pretrained_cfg` says.
        size: side to which photographs of a folder are resized [pixels], by default 224.
        outputs: "classes": the network has an output for each class of the images, perhaps with others behind them;
            "imagenet": it has those of ImageNet, of which only those of the classes, named by WordNet ids, are answers;
            "all_imagenet": all of them are answers.
        max_images: maximum number of images of a folder or of a data set of known length, drawn at random.
        rays: number of rays of each field and colour.

    Raises:
        InputError: an image cannot be read, the network does not return logits, or recognises sharp images no better
            than by guessing, or a field gets no light.

    Example:
        >>> tasklens.rank({name: tasklens.load_lens(f"{name}.zmx") for name in ("a", "b")}, "photographs", network)
    """
    if not isinstance(lenses, Mapping) or not all(
        isinstance(pair, tuple) and len(pair) == 2 for pair in lenses.values()
    ):
        raise InputError('rank: expected lenses by name, such as {"mine": tasklens.load_lens("mine.zmx")}')
    if isinstance(images, str | Path):
        dataset = test_images(Path(images), PHOTOGRAPH_SIZE if size is None else size, max_images)
    elif size is not None:
        raise InputError("size: only for a folder of photographs; resize the images of your data set")
    else:
        dataset = pairs.of_pairs(images, max_images)
    if not lenses or not len(dataset):
        raise InputError("rank: expected lenses and images")
    pairs.check_classes(dataset)
    if not isinstance(network, nn.Module):
        raise InputError(f"rank: expected a torch.nn.Module, got {type(network).__name__}")
    for name, (lens, view) in lenses.items():
        _check_light(name, lens, view.at(sum(GRADING, ())))
    subject = on_sharp_images(network, dataset, outputs)
    try:
        better_than_guessing(subject.accuracy, len(dataset), subject.outputs)
    except TooFewImages as error:
        warnings.warn(f"rank: {error}", stacklevel=3)
    except InputError as error:
        raise InputError(f"rank: {error}") from None
    ranking = measure_lenses(lenses, subject, rays)
    for sentence in between_fields.warnings(ranking.correct, ranking.at_nine):
        warnings.warn(f"rank: {sentence}", stacklevel=3)
    return ranking


@dataclass(frozen=True)
class OnSharpImages:
    """A frozen network and images on its device, with its accuracy on them, and the number of its possible answers."""

    network: Classifier
    images: ImageDataset
    accuracy: float
    outputs: int


def on_sharp_images(network: nn.Module, dataset: ImageDataset, outputs: str = "classes") -> OnSharpImages:
    """Freeze a copy of a network, and compute its accuracy on sharp images.

    Args:
        outputs: as in `rank`.

    Raises:
        InputError: the network does not return logits of the classes.
    """
    device = next((parameter.device for parameter in network.parameters()), CPU)
    dataset = replace(dataset, device=device)
    used = classifiers.used_outputs(outputs, dataset.classes)
    image = dataset.batch(torch.arange(1))[0]
    try:
        classifier = classifiers.frozen(classifiers.of_user(network).to(device), image)
        with torch.no_grad():
            answer = classifier(image)
    except InputError:
        raise
    except Exception as error:  # of any layer
        raise InputError(f"rank: the network fails for images {tuple(image.shape[1:])}: {error}") from error
    least = max(len(dataset.classes), 2) if used is None else ImageNetInfo().num_classes()
    if answer.dim() != 2 or answer.shape[1] < least:
        classes = f"{len(dataset.classes)} classes" if used is None else f"{least} classes of ImageNet (`outputs`)"
        raise InputError(
            f"rank: the network returns a tensor {tuple(answer.shape)} for one image; expected logits of the {classes}"
        )
    if not answer.isfinite().all():
        raise InputError("rank: the network returns logits that are not finite")
    classifier.outputs = None if used is None else used.to(device)
    sharp = evaluation.evaluate(classifier, dataset, CapturePipeline(), "sharp images")
    accuracy = float(sharp.correct.double().mean())
    return OnSharpImages(classifier, dataset, accuracy, answer.shape[1] if used is None else len(used))


def measure_lenses(lenses: Mapping[str, tuple[Lens, View]], subject: OnSharpImages, rays: int = _RAYS) -> Ranking:
    """Return the ranking of lenses for a network."""
    correct, at_nine = {}, {}
    for name, (lens, view) in lenses.items():
        correct[name], inside = predictions(subject, lens, view, GRADING, name, rays)
        if remark := window_remark(inside, view.kernel_size):
            warnings.warn(f"rank: {name}: {remark}", stacklevel=4)
        at_nine[name], _ = predictions(subject, lens, view, (PAPER,), name, rays)
    table = report.rank_lenses(correct, at_nine)
    figures, drawings = [], {}
    for name in table["lens"]:
        lens, view = lenses[name]
        figures.append(
            {
                "f_number": float(paraxial(lens.detached(), view.reference_um).f_number),
                "field_of_view_deg": 2 * degrees(atan(float(view.radii.max()) / view.efl)),
                "rms_spot_um": means(lens, view.at(GRADING_CENTRES), rays)["rms_spot_um"],
            }
        )
        drawings[name] = section_svg(lens.detached(), view)
    return Ranking(table.join(pandas.DataFrame(figures)), correct, at_nine, drawings, 100 * subject.accuracy)


def _check_light(name: str, lens: Lens, view: View) -> None:
    try:
        check_light(lens, view)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def predictions(
    subject: OnSharpImages, lens: Lens, view: View, fields: Sequence[Points], name: str, rays: int = _RAYS
) -> tuple[pandas.DataFrame, Tensor]:
    """Return the predictions through a lens, a row per image and a column per field, and the energies in the window.

    Args:
        fields: sets of as many fields, which images take in turns.
        name: name of the lens, for messages.
    """
    lens, view = lens.detached(), view.in_colours().at(sum(fields, ()))
    _check_light(name, lens, view)
    grid = evaluation_psf(lens, view, rays)
    camera = PsfCamera(grid.to(subject.images.device))
    correct = evaluation.evaluate(
        subject.network, subject.images, CapturePipeline(camera, turns=len(fields)), name
    ).correct
    frame = pandas.DataFrame(evaluation.by_image({"field": correct.int()}, subject.images))
    return frame.set_index(["image", "label"]), energy_inside(grid)
