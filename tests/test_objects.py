"""Rendered images of one texture; images with objects: rendered, their files, and annotations in the format of COCO."""

import json

import numpy
import pytest
import torch
from examples import write
from PIL import Image

from tasklens.recognition import coco, object_scenes, objects, scenes
from tasklens.runtime.files import FileError
from tasklens.settings.image_settings import RENDERED_CLASSES

# ---- one texture


def test_images_are_balanced_and_shuffled():
    images, labels = scenes.render(53, 16, seed=1)
    assert images.shape == (53, 3, 16, 16) and images.dtype == torch.uint8
    counts = torch.bincount(labels, minlength=len(scenes.CLASSES))
    assert counts.max() - counts.min() <= 1 and counts.sum() == 53
    assert not torch.equal(labels, labels.sort().values)


def test_shorter_periods_have_higher_frequencies():
    """The mean frequency of the textures' power, weighted by it, grows as the periods fall."""

    def frequency(periods):
        images = scenes.render(50, 64, 3, periods)[0].double()
        power = torch.fft.rfft2(images - images.mean((-2, -1), keepdim=True)).abs().square().mean((0, 1))
        radius = torch.hypot(torch.fft.fftfreq(64)[:, None], torch.fft.rfftfreq(64)).double()
        high = radius > 1 / 20  # the ground is soft
        return float((power * radius)[high].sum() / power[high].sum())

    assert frequency((3.5, 8.0)) > 1.3 * frequency((5.0, 16.0)) > 1.3 * frequency((12.0, 16.0))


def test_means_tell_nothing_about_the_class():
    """Brightness and contrast have one distribution: class means differ by no more than chance, F(9, 590) < 3."""
    images, labels = scenes.render(600, 32, seed=2)
    values = images.float() / 255
    for feature in (values.mean((1, 2, 3)), values.mean((2, 3))[:, 0], values.std((1, 2, 3))):
        groups = [feature[labels == k] for k in range(len(scenes.CLASSES))]
        between = sum(len(g) * (g.mean() - feature.mean()) ** 2 for g in groups) / (len(groups) - 1)
        within = sum(((g - g.mean()) ** 2).sum() for g in groups) / (len(feature) - len(groups))
        assert float(between / within) < 3


def test_a_study_knows_how_many_classes_there_are():
    assert len(scenes.CLASSES) == RENDERED_CLASSES


# ---- objects


def render(count: int = 4, size: int = 64, seed: int = 0) -> objects.ObjectDataset:
    return object_scenes.render(count, size, seed)


def test_scenes_hold_visible_objects():
    """One to four each, at least half of each seen, no pixel of two; all classes come up."""
    dataset = render(40)
    assert dataset.images.shape == (40, 3, 64, 64) and dataset.classes == scenes.CLASSES
    numbers = torch.bincount(dataset.owner, minlength=40)
    assert numbers.min() >= 1 and numbers.max() == object_scenes.MOST
    assert set(dataset.labels.tolist()) == set(range(len(scenes.CLASSES)))
    for image in range(40):
        labels, masks = dataset.objects_of(image)
        assert len(labels) == len(masks) == numbers[image]
        assert masks.sum(0).max() == 1
        assert ((masks.sum((1, 2)) > 0.02 * 64**2) & (masks.sum((1, 2)) < 0.25 * 64**2)).all()


def test_scenes_too_small_for_an_object_are_refused():
    with pytest.raises(ValueError, match="expected at least one of 32"):
        object_scenes.render(1, 30, 0)


def test_masks_are_where_the_texture_is():
    """A pixel inside differs from one outside by more detail: high frequencies of the image are those of objects."""
    dataset = render(20)
    grey = dataset.images.float().mean(1)
    detail = (grey - torch.nn.functional.avg_pool2d(grey[:, None], 5, 1, 2)[:, 0]).abs()
    inside = torch.stack([dataset.objects_of(k)[1].any(0) for k in range(20)])
    assert detail[inside].mean() > 1.5 * detail[~inside].mean()


def test_the_map_of_classes_has_smaller_objects_on_top():
    masks = torch.zeros(2, 8, 8, dtype=torch.bool)
    masks[0, 1:3, 1:3] = True
    masks[1, 0:6, 0:6] = True
    class_map = objects.semantic(torch.tensor([4, 0]), masks)
    assert class_map[1, 1] == 5 and class_map[5, 5] == 1 and class_map[7, 7] == 0


def test_files_hold_a_split(tmp_path):
    dataset = render()
    paths = tmp_path / "test.npy", tmp_path / "test.safetensors"
    objects.write(dataset, *paths)
    again = objects.read(*paths)
    assert again.classes == dataset.classes and len(again) == 4
    for name in ("images", "owner", "labels", "masks"):
        assert torch.equal(getattr(again, name), getattr(dataset, name))
    assert torch.equal(again.objects_of(3)[1], dataset.objects_of(3)[1])
    assert again.as_images().labels.tolist() == [0, 1, 2, 3]


def test_files_of_different_splits_are_refused(tmp_path):
    for count in (4, 8):
        objects.write(render(count), tmp_path / f"{count}.npy", tmp_path / f"{count}.safetensors")
    with pytest.raises(FileError, match=r"8\.safetensors.*images that .*4\.npy does not have"):
        objects.read(tmp_path / "4.npy", tmp_path / "8.safetensors")
    objects.write(render(4, 32), tmp_path / "small.npy", tmp_path / "small.safetensors")
    with pytest.raises(FileError, match=r"small\.safetensors"):
        objects.read(tmp_path / "4.npy", tmp_path / "small.safetensors")


# ---- COCO


SQUARE = [[4.0, 4.0, 28.0, 4.0, 28.0, 20.0, 4.0, 20.0]]


def coco_folder(folder, change=lambda content: None):
    """Three images, two classes: polygons, a run-length encoding and a crowd."""
    (folder / "annotations").mkdir(parents=True)
    (folder / "val").mkdir()
    generator = numpy.random.default_rng(0)
    for name in "abc":
        Image.fromarray(generator.integers(0, 255, (32, 40, 3), dtype="uint8")).save(folder / f"val/{name}.png")
    runs = numpy.zeros((32, 40), dtype=bool)
    runs[10:20, 6:16] = True
    flat = runs.T.ravel()
    ends = numpy.flatnonzero(numpy.diff(flat)) + 1
    counts = numpy.diff([0, *ends.tolist(), flat.size]).tolist()  # column by column, from outside
    encoded = {"size": [32, 40], "counts": counts}
    content = {
        "images": [{"id": k, "file_name": f"{name}.png", "width": 40, "height": 32} for k, name in enumerate("abc")],
        "categories": [{"id": 7, "name": "cat"}, {"id": 3, "name": "dog"}],
        "annotations": [
            {"id": 1, "image_id": 0, "category_id": 7, "segmentation": SQUARE},
            {"id": 2, "image_id": 0, "category_id": 3, "segmentation": encoded, "iscrowd": 0},
            {"id": 3, "image_id": 1, "category_id": 3, "segmentation": SQUARE},
            {"id": 4, "image_id": 1, "category_id": 3, "segmentation": SQUARE, "iscrowd": 1},
        ],
    }  # fmt: skip
    change(content)
    (folder / "annotations" / "instances_val.json").write_text(json.dumps(content))
    return folder


def test_a_folder_of_coco_is_read(tmp_path):
    """Images without objects and crowds are left out; masks are those of the central square, at the wanted size."""
    dataset = coco.read(coco_folder(tmp_path), "val", 64, None, seed=0)
    assert dataset.classes == ("dog", "cat") and len(dataset) == 2
    assert sorted(torch.bincount(dataset.owner).tolist()) == [1, 2]
    first = next(k for k in range(2) if len(dataset.objects_of(k)[0]) == 2)
    labels, masks = dataset.objects_of(first)
    assert labels.tolist() == [1, 0]  # cat, dog
    # The square of 32 x 32 begins at column 4, and is doubled.
    assert objects.boxes(masks).tolist() == [[0, 8, 48, 40], [4, 20, 24, 40]]


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda c: c["annotations"][0].update(segmentation=[[50, 1, 60, 1, 60, 9]]), "1 of a.png: a polygon lies"),
        (lambda c: c["annotations"][0].update(segmentation=[[1, 1, 2, 2]]), "three points or more"),
        (lambda c: c["annotations"][0].update(segmentation=["1, 1, 9, 1, 9, 9"]), "three points or more"),
        (lambda c: c["annotations"][0].update(segmentation=[]), "has no polygon"),
        (lambda c: c["annotations"][1]["segmentation"].update(size=[40, 32]), "of 32 rows and 40 columns"),
        (lambda c: c["annotations"][1]["segmentation"].update(counts="§"), "annotation 2 of a.png"),
        (lambda c: c["annotations"][0].update(category_id=9), "category 9 is not listed"),
        (lambda c: c["annotations"][0].update(image_id=9), "image 9 that is not listed"),
        (lambda c: c["annotations"][0].pop("segmentation"), r"annotations\[0\] has no segmentation"),
        (lambda c: c["categories"].append({"id": 5, "name": "cow"}), "no object of cow"),
        (lambda c: c["images"][0].update(width=41), "has 40 x 32 pixels, not 41 x 32"),
        (lambda c: c["images"][0].update(width="40"), r"images\[0\] has no width of the type"),
        (lambda c: c["images"][0].update(file_name="z.png"), "z.png"),
        (lambda c: c.update(annotations=[]), "no image has an object"),
        (lambda c: c.pop("categories"), "no list `categories`"),
    ],
)  # fmt: skip
def test_bad_annotations_are_refused(tmp_path, change, words):
    with pytest.raises(FileError, match=words):
        coco.read(coco_folder(tmp_path, change), "val", 32, None, seed=0)


def test_absent_and_broken_annotations(tmp_path):
    with pytest.raises(FileError, match=r"instances_val\.json: no such file"):
        coco.read(tmp_path, "val", 32, None, seed=0)
    write(tmp_path / "annotations" / "instances_val.json", "{")
    with pytest.raises(FileError, match=r"instances_val\.json: not valid JSON"):
        coco.read(tmp_path, "val", 32, None, seed=0)
