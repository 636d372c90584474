"""The same test images through every lens, and what each network answers."""

from collections.abc import Mapping

import torch
from safetensors.numpy import save_file
from timm.data import ImageNetInfo
from torch import Tensor

from restoration import nafnet
from tasklens.imaging import Camera, psnr
from tasklens.optics.io import psf_files
from tasklens.recognition import classifiers, dataset
from tasklens.recognition.classifiers import Classifier
from tasklens.report.chosen_images import choose
from tasklens.runtime.devices import claim
from tasklens.runtime.files import Files, replacing, write_rows
from tasklens.study import names
from tasklens.study.names import SHARP
from tasklens.study.settings import Slice

FIELDS = {0: "axis", 4: "middle", 8: "corner"}  # of the nine fields


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Write the captures (image, field, 3, H, W) of each lens as uint8, and the answers as CSV.

    Raises:
        FileError: no lens has been measured yet.
    """
    device = claim()
    test = dataset.read(*inputs.test, device=device)
    chosen = choose(inputs.predictions)
    images, labels = test.batch(torch.tensor(chosen))
    known = _class_names()
    seen: dict[tuple[str, bool], Tensor] = {(SHARP, False): images[:, None]}  # (image, field, 3, H, W)
    for lens, path in inputs.psfs.items():
        seen_fields = (tensor[list(FIELDS)].to(device) for tensor in psf_files.read(path))
        camera = Camera.of(settings.captures[lens], *seen_fields)
        seen[lens, False] = camera.grid(images).transpose(0, 1)
        if lens in inputs.restorations:
            network = nafnet.load(settings.restoration, inputs.restorations[lens]).to(device)
            restored = network(seen[lens, False].flatten(0, 1))
            seen[lens, True] = restored.unflatten(0, (len(chosen), -1))
    rows = []
    for (lens, measured_name), path in inputs.weights.items():
        name, restored = names.split(measured_name)
        if (lens, restored) not in seen:
            continue  # of a study that is not finished
        classifier = classifiers.build(settings.classifiers[name], test.classes, path).eval().to(device)
        answers = _answers(classifier, seen[lens, restored], test.classes, known)
        quality = psnr(seen[lens, restored], images[:, None]).tolist()
        for k, image in enumerate(chosen):
            own = test.classes[int(labels[k])]
            for f, (answer, probability) in enumerate(answers[k]):
                field = "" if lens == SHARP else list(FIELDS.values())[f]
                keys = {"image": image, "label": known.get(own, own), "lens": lens, "field": field}
                keys |= {"restored": restored, "classifier": name, "answer": answer, "probability": probability}
                rows.append(keys | {"psnr_db": None if lens == SHARP else quality[k][f]})
    write_rows(outputs.answers, rows)
    tensors = {names.measured(*key): _bytes(found) for key, found in seen.items()}
    with replacing(outputs.images) as temporary:
        save_file({name: tensor.cpu().numpy() for name, tensor in tensors.items()}, temporary)


def _bytes(images: Tensor) -> Tensor:
    return (255 * images).round().clamp(0, 255).byte().contiguous()


@torch.no_grad()
def _answers(
    classifier: Classifier, captures: Tensor, classes: tuple[str, ...], known: Mapping[str, str]
) -> list[list[tuple[str, float]]]:
    """Return the answer and its probability [%] by image and field, of captures (image, field, 3, H, W)."""
    shares, best = classifier(captures.flatten(0, 1)).softmax(-1).max(-1)
    info = ImageNetInfo()

    def name(answer: int) -> str:
        if answer < len(classes):
            return known.get(classes[answer], classes[answer])
        assert classifier.outputs is not None  # only a network of ImageNet has more outputs than classes
        return str(info.index_to_description(int(classifier.outputs[answer])).split(",")[0])

    found = [(name(answer), 100 * share) for answer, share in zip(best.tolist(), shares.tolist(), strict=True)]
    width = captures.shape[1]
    return [found[start : start + width] for start in range(0, len(found), width)]


def _class_names() -> dict[str, str]:
    """Return the English names of ImageNet's classes by WordNet id."""
    info = ImageNetInfo()
    return {name: info.label_name_to_description(name).split(",")[0] for name in info.label_names()}
