"""Photographs with objects in COCO format: annotations/instances_<split>.json next to <split>/*.jpg.

Images and masks are cropped to the central square and resized; boxes are computed from the cropped masks.
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

from tasklens.recognition import image_tensors
from tasklens.recognition.objects import ObjectDataset, pack
from tasklens.runtime.files import FileError
from tasklens.runtime.progress import Progress

_NAMES = {"train": ("train2017", "train"), "test": ("val2017", "val")}  # possible names of the splits
_LEAST_PIXELS = 12  # minimum area of an object after the crop


def split_names(folder: Path) -> dict[str, str]:
    """Return the names in a folder of the splits `train` and `test`; raises FileError if one has no annotations."""
    chosen = {}
    for split, names in _NAMES.items():
        existing = [name for name in names if (folder / "annotations" / f"instances_{name}.json").exists()]
        if not existing:
            raise FileError(f"{folder}: has no annotations/instances_{names[0]}.json, nor instances_{names[1]}.json")
        chosen[split] = existing[0]
    return chosen


def read(folder: Path, split: str, size: int, limit: int | None, seed: int) -> ObjectDataset:
    """Read at most `limit` images of a split, at random by `seed`, among the images that have an object.

    Crowds (`iscrowd`) are omitted, and objects with fewer than 12 pixels after the crop.

    Args:
        split: such as `train2017`.
        size: side of the square images [pixels].

    Raises:
        FileError: a file is missing or not an image, the annotations are incomplete, an object is outside its image,
            a mask has another size, or a class has no object.
    """
    path = folder / "annotations" / f"instances_{split}.json"
    content = _content(path)
    names = {entry["id"]: str(entry["name"]) for entry in content["categories"]}
    by_image: dict[Any, list[Mapping[str, Any]]] = {}
    for entry in content["annotations"]:
        if not entry.get("iscrowd"):
            by_image.setdefault(entry["image_id"], []).append(entry)
    image_entries = {entry["id"]: entry for entry in content["images"]}
    for image in by_image:
        if image not in image_entries:
            raise FileError(f"{path}: annotation of an image {image!r} that is not listed in `images`")
    entries = [entry for image, entry in image_entries.items() if image in by_image]
    if not entries:
        raise FileError(f"{path}: no image has an object")
    order = torch.randperm(len(entries), generator=torch.Generator().manual_seed(seed))[:limit]
    classes = {identity: label for label, identity in enumerate(sorted(names))}
    progress = Progress(f"reading {folder / split}", len(order))
    images = torch.empty(len(order), 3, size, size, dtype=torch.uint8)
    owners, labels, masks = [], [], []
    for k, entry in enumerate(entries[k] for k in order.tolist()):
        photograph = image_tensors.decode(folder / split / entry["file_name"])
        if photograph.size != (entry["width"], entry["height"]):
            raise FileError(
                f"{path}: image {entry['file_name']} has {photograph.size[0]} x {photograph.size[1]} pixels, "
                f"not {entry['width']} x {entry['height']}"
            )
        square = ImageOps.fit(photograph, (size, size), Image.Resampling.BICUBIC)
        images[k] = torch.from_numpy(numpy.array(square)).permute(2, 0, 1)
        for annotation in by_image[entry["id"]]:
            location = f"{path}: annotation {annotation.get('id')!r} of {entry['file_name']}"
            if annotation["category_id"] not in classes:
                raise FileError(f"{location}: category {annotation['category_id']!r} is not listed in `categories`")
            mask = _mask(annotation, entry, location)
            small = ImageOps.fit(Image.fromarray(255 * mask), (size, size), Image.Resampling.BOX)
            visible = torch.from_numpy(numpy.array(small)) > 127
            if int(visible.sum()) >= _LEAST_PIXELS:
                owners.append(k)
                labels.append(classes[annotation["category_id"]])
                masks.append(pack(visible[None]))
        progress(k + 1)
    missing = [names[identity] for identity, label in classes.items() if label not in set(labels)]
    if missing:
        raise FileError(
            f"{path}: no object of {', '.join(missing)} in the {len(images)} chosen images; take more (`train`, "
            "`test`), or another seed"
        )
    return ObjectDataset(
        images,
        torch.tensor(owners),
        torch.tensor(labels),
        torch.cat(masks),
        tuple(names[identity] for identity in classes),
    )


def _content(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Read the annotations, and check that every entry has the required keys, with values of their types."""
    required_keys: dict[str, dict[str, Any]] = {
        "images": {"id": int | str, "file_name": str, "width": int, "height": int},
        "categories": {"id": int, "name": str},
        "annotations": {"image_id": int | str, "category_id": int, "segmentation": list | dict},
    }
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileError(f"{path}: no such file; expected COCO's annotations of instances") from None
    except ValueError as error:
        raise FileError(f"{path}: not valid JSON ({error})") from error
    for section, keys in required_keys.items():
        entries = content.get(section) if isinstance(content, dict) else None
        if not isinstance(entries, list):
            raise FileError(f"{path}: has no list `{section}`; expected annotations in the format of COCO")
        for number, entry in enumerate(entries):
            values = entry if isinstance(entry, dict) else {}
            if wrong := [key for key, kind in keys.items() if not isinstance(values.get(key), kind)]:
                raise FileError(f"{path}: {section}[{number}] has no {', '.join(wrong)} of the type in COCO")
    return content


def _mask(annotation: Mapping[str, Any], image: Mapping[str, Any], location: str) -> numpy.ndarray:
    """Decode the mask (H, W) uint8 from polygons or a run-length encoding."""
    from pycocotools import mask as encoding

    height, width, shape = image["height"], image["width"], annotation["segmentation"]
    if isinstance(shape, list):
        for polygon in shape:
            try:
                points = numpy.asarray(polygon, dtype=float)
            except (TypeError, ValueError):
                points = numpy.empty(0)
            if points.ndim != 1 or points.size < 6 or points.size % 2:
                raise FileError(f"{location}: a polygon needs three points or more, two numbers each")
            x, y = points[::2], points[1::2]
            if (
                x.max() <= 0
                or y.max() <= 0
                or x.min() >= width
                or y.min() >= height
                or not numpy.isfinite(points).all()
            ):
                raise FileError(f"{location}: a polygon lies outside the image of {width} x {height} pixels")
        if not shape:
            raise FileError(f"{location}: has no polygon")
    elif shape.get("size") != [height, width]:
        raise FileError(f"{location}: expected a mask of {height} rows and {width} columns, got {shape.get('size')!r}")
    try:
        with redirect_stdout(StringIO()):
            if isinstance(shape, list):
                runs = encoding.merge(encoding.frPyObjects(shape, height, width))
            else:
                runs = encoding.frPyObjects(shape, height, width) if isinstance(shape["counts"], list) else shape
            return encoding.decode(runs)
    except Exception as error:  # any type, raised by compiled code
        raise FileError(f"{location}: cannot be read as a mask ({error})") from error
