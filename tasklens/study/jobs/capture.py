"""Captures of the same test images through every lens, and the predictions of each network."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas
import torch
from timm.data import ImageNetInfo
from torch import Tensor

from restoration import nafnet
from tasklens.camera.imaging import PsfCamera, psnr
from tasklens.optics.io import psf_files
from tasklens.recognition import classifiers, dataset
from tasklens.recognition.classifiers import Classifier
from tasklens.runtime.devices import claim
from tasklens.runtime.files import FileError, write_rows, write_tensors
from tasklens.settings import names
from tasklens.settings.names import SHARP
from tasklens.show import predictions
from tasklens.study.report_jobs import CapturesJob

FIELDS = {0: "axis", 4: "middle", 8: "corner"}  # labels of three of the nine fields
_DIVIDING = 2  # number of images that divide the lenses


def run(
    settings: CapturesJob,
    test: Sequence[Path],
    psfs: Sequence[Path],
    restorations: Sequence[Path],
    weights: Sequence[Path],
    correct: Sequence[Path],
    images: Path,
    answers: Path,
) -> None:
    """Write the captures (image, field, 3, H, W) of each lens as uint8, and the predictions as CSV.

    Args:
        psfs: PSFs of the lenses in `settings.captures`.
        restorations: restoration networks of the lenses in `settings.restored_lenses`.
        weights: networks of `settings.measured`.
        correct: prediction files of `settings.chosen_by`.
    """
    device = claim()
    dataset_of_test = dataset.read(*test, device=device)
    classes = dataset_of_test.classes
    indices = choose(dict(zip(settings.chosen_by, correct, strict=True)))
    sharp, labels = dataset_of_test.batch(torch.tensor(indices))
    class_names = _class_names()
    captures: dict[tuple[str, bool], Tensor] = {(SHARP, False): sharp[:, None]}  # (image, field, 3, H, W)
    for lens, psf in zip(settings.captures, psfs, strict=True):
        grid, light, _ = psf_files.read(psf, "nine")
        field_tensors = (tensor[list(FIELDS)].to(device) for tensor in (grid, light))
        camera = PsfCamera.of(settings.captures[lens], *field_tensors)
        captures[lens, False] = camera.all_fields(sharp, torch.Generator().manual_seed(0)).transpose(0, 1)
    for lens, path in zip(settings.restored_lenses, restorations, strict=True):
        assert settings.restoration is not None  # settings of the networks
        network = nafnet.load(settings.restoration, path).to(device)
        captures[lens, True] = network(captures[lens, False].flatten(0, 1)).unflatten(0, (len(indices), -1))
    rows = []
    for (lens, measured_name), path in zip(settings.measured, weights, strict=True):
        name, restored = names.split(measured_name)
        classifier = classifiers.build(settings.classifiers[name], classes, path).eval().to(device)
        by_image = _answers(classifier, captures[lens, restored], classes, class_names)
        quality = psnr(captures[lens, restored], sharp[:, None]).tolist()
        for k, image in enumerate(indices):
            class_id = classes[int(labels[k])]
            for f, (answer, probability) in enumerate(by_image[k]):
                field = "" if lens == SHARP else list(FIELDS.values())[f]
                keys = {"image": image, "label": class_names.get(class_id, class_id), "lens": lens, "field": field}
                keys |= {"restored": restored, "classifier": name, "answer": answer, "probability": probability}
                rows.append(keys | {"psnr_db": None if lens == SHARP else quality[k][f]})
    write_rows(answers, rows)
    levels = {
        names.measured_name(*key): (255 * capture).round().clamp(0, 255).byte() for key, capture in captures.items()
    }
    write_tensors(images, levels, {})


@torch.no_grad()
def _answers(
    classifier: Classifier, captures: Tensor, classes: tuple[str, ...], descriptions: Mapping[str, str]
) -> list[list[tuple[str, float]]]:
    """Return the prediction and its probability [%] by image and field, for captures (image, field, 3, H, W)."""
    shares, best = classifier(captures.flatten(0, 1)).softmax(-1).max(-1)
    info = ImageNetInfo()

    def name(answer: int) -> str:
        if answer < len(classes):
            return descriptions.get(classes[answer], classes[answer])
        assert classifier.outputs is not None  # only an ImageNet network has more outputs than classes
        return str(info.index_to_description(int(classifier.outputs[answer])).split(",")[0])

    answers = [(name(answer), 100 * share) for answer, share in zip(best.tolist(), shares.tolist(), strict=True)]
    width = captures.shape[1]
    return [answers[start : start + width] for start in range(0, len(answers), width)]


def _class_names() -> dict[str, str]:
    """Return the English names of ImageNet's classes by WordNet id."""
    info = ImageNetInfo()
    return {name: info.label_name_to_description(name).split(",")[0] for name in info.label_names()}


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
