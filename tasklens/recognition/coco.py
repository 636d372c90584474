"""Photographs with objects in the format of COCO: annotations/instances_<split>.json beside <split>/*.jpg.

Images are cut to their central square and resized, and so are the masks; boxes are those of the masks that are left.
"""

import json
from collections.abc import Mapping
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy
import torch
from PIL import Image, ImageOps

from tasklens.recognition import folders
from tasklens.recognition.objects import ObjectDataset, packed
from tasklens.runtime.files import FileError
from tasklens.runtime.progress import Progress

_LEAST_PIXELS = 12  # of an object that is left: smaller ones are specks


def read(folder: Path, split: str, size: int, limit: int | None, seed: int) -> ObjectDataset:
    """Read a split; at most `limit` images, chosen at random by `seed`, of those that have an object.

    Objects of which fewer than 12 pixels are left, and crowds (`iscrowd`), are left out.

    Args:
        split: such as `train2017`.
        size: side of the square images [pixels].

    Raises:
        FileError: a file is missing or no image, the annotations are incomplete, an object is outside its image, a mask
            is of another size, or a class has no object.
    """
    path = folder / "annotations" / f"instances_{split}.json"
    content = _content(path)
    names = {entry["id"]: str(entry["name"]) for entry in content["categories"]}
    by_image: dict[Any, list[Mapping[str, Any]]] = {}
    for entry in content["annotations"]:
        if not entry.get("iscrowd"):
            by_image.setdefault(entry["image_id"], []).append(entry)
    listed = {entry["id"]: entry for entry in content["images"]}
    for image in by_image:
        if image not in listed:
            raise FileError(f"{path}: annotation of an image {image!r} that is not listed in `images`")
    kept = [entry for image, entry in listed.items() if image in by_image]
    if not kept:
        raise FileError(f"{path}: no image has an object")
    order = torch.randperm(len(kept), generator=torch.Generator().manual_seed(seed))[:limit]
    classes = {identity: label for label, identity in enumerate(sorted(names))}
    progress = Progress(f"reading {folder / split}", len(order))
    images = torch.empty(len(order), 3, size, size, dtype=torch.uint8)
    owners, labels, masks = [], [], []
    for k, entry in enumerate(kept[k] for k in order.tolist()):
        whole = folders.decode(folder / split / entry["file_name"])
        if whole.size != (entry["width"], entry["height"]):
            raise FileError(
                f"{path}: image {entry['file_name']} has {whole.size[0]} x {whole.size[1]} pixels, "
                f"not {entry['width']} x {entry['height']}"
            )
        fitted = ImageOps.fit(whole, (size, size), Image.Resampling.BICUBIC)
        images[k] = torch.from_numpy(numpy.array(fitted)).permute(2, 0, 1)
        for annotation in by_image[entry["id"]]:
            where = f"{path}: annotation {annotation.get('id')!r} of {entry['file_name']}"
            if annotation["category_id"] not in classes:
                raise FileError(f"{where}: category {annotation['category_id']!r} is not listed in `categories`")
            mask = _mask(annotation, entry, where)
            small = ImageOps.fit(Image.fromarray(255 * mask), (size, size), Image.Resampling.BOX)
            left = torch.from_numpy(numpy.array(small)) > 127
            if int(left.sum()) >= _LEAST_PIXELS:
                owners.append(k)
                labels.append(classes[annotation["category_id"]])
                masks.append(packed(left[None]))
        progress(k + 1)
    missing = [names[identity] for identity, label in classes.items() if label not in set(labels)]
    if missing:
        raise FileError(
            f"{path}: no object of {', '.join(missing)} in the {len(images)} images that were chosen; take more "
            "(`train`, `test`), or another seed"
        )
    return ObjectDataset(
        images,
        torch.tensor(owners),
        torch.tensor(labels),
        torch.cat(masks),
        tuple(names[identity] for identity in classes),
    )


def _content(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Read the annotations, and check what every entry must have."""
    needed = {
        "images": ("id", "file_name", "width", "height"),
        "categories": ("id", "name"),
        "annotations": ("image_id", "category_id", "segmentation"),
    }
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileError(f"{path}: no such file; expected COCO's annotations of instances") from None
    except ValueError as error:
        raise FileError(f"{path}: no JSON ({error})") from error
    for section, keys in needed.items():
        entries = content.get(section) if isinstance(content, dict) else None
        if not isinstance(entries, list):
            raise FileError(f"{path}: has no list `{section}`, as COCO's annotations have")
        for number, entry in enumerate(entries):
            absent = [key for key in keys if not isinstance(entry, dict) or key not in entry]
            if absent:
                raise FileError(f"{path}: {section}[{number}] has no {', '.join(absent)}")
    return content


def _mask(annotation: Mapping[str, Any], image: Mapping[str, Any], where: str) -> numpy.ndarray:
    """Return the mask (H, W) uint8 of polygons or of a run-length encoding."""
    from pycocotools import mask as encoding

    height, width, shape = image["height"], image["width"], annotation["segmentation"]
    if isinstance(shape, list):
        for polygon in shape:
            points = numpy.asarray(polygon, dtype=float)
            if points.size < 6 or points.size % 2:
                raise FileError(f"{where}: a polygon needs three points or more, two numbers each")
            x, y = points[::2], points[1::2]
            if (
                x.max() <= 0
                or y.max() <= 0
                or x.min() >= width
                or y.min() >= height
                or not numpy.isfinite(points).all()
            ):
                raise FileError(f"{where}: a polygon lies outside the image of {width} x {height} pixels")
        if not shape:
            raise FileError(f"{where}: has no polygon")
    elif not isinstance(shape, dict) or list(shape.get("size", ())) != [height, width]:
        size = shape.get("size") if isinstance(shape, dict) else shape
        raise FileError(f"{where}: expected a mask of {height} rows and {width} columns, got {size!r}")
    try:
        with redirect_stdout(StringIO()):
            if isinstance(shape, list):
                runs = encoding.merge(encoding.frPyObjects(shape, height, width))
            else:
                runs = encoding.frPyObjects(shape, height, width) if isinstance(shape["counts"], list) else shape
            return encoding.decode(runs)
    except Exception as error:  # of any kind, from compiled code
        raise FileError(f"{where}: cannot be read as a mask ({error})") from error
