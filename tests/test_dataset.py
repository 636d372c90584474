"""Splits of images, from the renderer and from folders of photographs."""

import itertools
import json
import multiprocessing
import os
from pathlib import Path

import numpy
import pytest
import torch
from examples import random_images
from PIL import Image
from reference_files import SHIPPED

from tasklens.recognition import dataset as data
from tasklens.recognition import folders, image_tensors
from tasklens.runtime import checkpoints, files
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.files import FileError
from tasklens.settings.image_settings import ImageSettings
from tasklens.settings.names import SPLITS
from tasklens.study.job_settings import folder_digest


def paths_in(folder: Path) -> dict[str, tuple[Path, Path]]:
    """Images and labels of every split."""
    return {split: (folder / f"{split}.npy", folder / f"{split}.json") for split in SPLITS}


def make_splits(folder: Path, images: ImageSettings) -> dict[str, data.ImageDataset]:
    """The splits, written to and read from files in `folder`."""
    data.make(images, paths_in(folder))
    return {split: data.read(*paths) for split, paths in paths_in(folder).items()}


def as_set(dataset: data.ImageDataset) -> set[bytes]:
    return {image.numpy().tobytes() for image in dataset.images}


def assert_equal(actual: data.ImageDataset, expected: data.ImageDataset) -> None:
    assert torch.equal(actual.images, expected.images) and torch.equal(actual.labels, expected.labels)


def test_splits_are_disjoint_and_deterministic(tmp_path):
    """The minival comes from the training images; no image is in two splits."""
    settings = ImageSettings(size=16, train=40, minival=15, test=55, seed=3)
    splits, again = (make_splits(tmp_path / name, settings) for name in ("first", "again"))
    assert {name: len(part) for name, part in splits.items()} == {"train": 40, "minival": 15, "test": 55}
    sets = [as_set(part) for part in splits.values()]
    assert len(set.union(*sets)) == sum(map(len, sets)) == 110
    for name, part in splits.items():
        assert_equal(again[name], part)
    other = make_splits(tmp_path / "other", settings.model_copy(update={"seed": 4}))
    assert not as_set(splits["train"]) & as_set(other["train"])
    assert not as_set(splits["test"]) & as_set(other["train"])


def test_images_survive_their_file(tmp_path):
    """Plain numpy reads the images, and any JSON reader the labels."""
    dataset, paths = random_images(6, 16, 3, seed=0), paths_in(tmp_path)["train"]
    data.write(dataset, *paths)
    reread = data.read(*paths)
    assert_equal(reread, dataset)
    assert reread.classes == dataset.classes and reread.labels.dtype == torch.long
    assert (numpy.load(paths[0]) == dataset.images.numpy()).all()
    assert json.loads(paths[1].read_text()) == {"classes": ["class0", "class1", "class2"], "labels": [0, 1, 2] * 2}


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="Linux tells what is mapped how")
def test_images_are_mapped_and_not_held(tmp_path):
    """The mapping is shared and read-only, so the file may exceed memory and swap; values equal the file's."""
    path, labels = paths_in(tmp_path)["train"]
    dataset = random_images(6, 16, 3, seed=0)
    data.write(dataset, path, labels)
    mapped = data.read(path, labels)
    mappings = [line.split() for line in Path("/proc/self/maps").read_text().splitlines() if str(path) in line]
    assert [fields[1] for fields in mappings] == ["r--s"]
    assert torch.equal(mapped.batch(torch.tensor([4, 1]))[0], dataset.batch(torch.tensor([4, 1]))[0])


@pytest.mark.parametrize("kept", [0, 100, -100])
def test_a_file_of_images_that_is_cut_is_named(tmp_path, kept):
    path, labels = paths_in(tmp_path)["train"]
    data.write(random_images(6, 16, 3, seed=0), path, labels)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(FileError, match=r"train\.npy: not a complete array; remove it"):
        data.read(path, labels)
    path.unlink()
    with pytest.raises(FileNotFoundError):
        data.read(path, labels)


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "not valid JSON"),
        ('{"classes": ["a"], "labels": [0, 0', "not valid JSON"),
        ('{"classes": ["a"]}', "no labels of images"),
        ('{"classes": ["a"], "labels": ["cat"]}', "no labels of images"),
        ("[]", "no labels of images"),
        ('{"classes": ["a"], "labels": [0, 0]}', "2 labels for the 6 images of"),
    ],
)
def test_labels_that_are_not_those_of_the_images_are_named(tmp_path, text, words):
    path, labels = paths_in(tmp_path)["train"]
    data.write(random_images(6, 16, 3, seed=0), path, labels)
    labels.write_text(text)
    with pytest.raises(FileError, match=f"^{labels}: {words}"):
        data.read(path, labels)


def make_folder(root, train=4):
    """Images of one grey per file: 10, 20, ... for cats, 110, 120, ... for dogs; test images are one level brighter."""
    for split, count in (("train", train), ("val", 2)):
        for k, name in enumerate(("cat", "dog")):
            (root / split / name).mkdir(parents=True)
            for i in range(count):
                value = 100 * k + 10 * (i + 1) + (split != "train")
                Image.new("RGB", (20, 30), (value,) * 3).save(root / split / name / f"{i}.png")
    return root


def test_folder_of_photographs(tmp_path):
    """train/ and val/ with a folder per class; every image keeps its class, minival and train stay apart."""
    splits = make_splits(tmp_path, ImageSettings(size=16, minival=3, folder=make_folder(tmp_path)))
    assert {name: len(part) for name, part in splits.items()} == {"train": 5, "minival": 3, "test": 4}
    for name, part in splits.items():
        assert part.classes == ("cat", "dog") and part.images.shape[1:] == (3, 16, 16)
        greys = part.images[:, 0, 0, 0].long()
        assert torch.equal((greys > 100).long(), part.labels), name
        assert ((greys % 10 == 1) == (name == "test")).all()
        files = json.loads((tmp_path / f"{name}.json").read_text())["files"]
        assert [Image.open(file).getpixel((0, 0))[0] for file in files] == greys.tolist()
    assert not as_set(splits["train"]) & as_set(splits["minival"])


def test_counts_limit_a_folder_evenly(tmp_path):
    splits = make_splits(tmp_path, ImageSettings(size=16, train=2, minival=2, test=2, folder=make_folder(tmp_path)))
    assert torch.bincount(torch.cat([splits["train"].labels, splits["minival"].labels])).tolist() == [2, 2]
    assert torch.bincount(splits["test"].labels).tolist() == [1, 1]


PHOTOGRAPHS = SHIPPED / "photographs"  # one photograph of 48 x 48 pixels in every format


@pytest.mark.parametrize("name", sorted(path.name for path in PHOTOGRAPHS.iterdir()))
def test_a_photograph_looks_alike_in_every_format(name):
    """Only the loss of the format, or of colour in grey formats; grey and colour differ by 22 levels."""
    with Image.open(PHOTOGRAPHS / "original.png") as original:
        converted = original.convert("L").convert("RGB") if "grey" in name else original.convert("RGB")
    expected = torch.from_numpy(numpy.array(converted)).permute(2, 0, 1)
    pixels = image_tensors.read(PHOTOGRAPHS / name, 48)
    lossless = name in ("original.png", "alpha.webp", "deep_grey.png", "deep_colour.png")
    difference = (pixels.float() - expected.float()).abs().mean()
    assert difference == 0 if lossless else difference < 5


def test_the_central_square_is_kept(tmp_path):
    """An image of 60 x 20 pixels with white ends becomes its black middle."""
    wide = Image.new("RGB", (60, 20), "white")
    wide.paste((0, 0, 0), (15, 0, 45, 20))
    wide.save(tmp_path / "wide.png")
    assert (image_tensors.read(tmp_path / "wide.png", 16) == 0).all()


def test_an_image_of_any_size_is_read(tmp_path):
    """Pillow alone refuses more than 179 million pixels."""
    Image.new("L", (190_000, 1_000), 60).save(tmp_path / "large.png", compress_level=1)
    assert (image_tensors.read(tmp_path / "large.png", 16) == 60).all()


def test_threads_change_nothing(tmp_path, monkeypatch):
    """The number of decoding threads is torch's number of threads."""
    settings = ImageSettings(size=16, minival=3, folder=make_folder(tmp_path, train=10))
    pools, pool = [], folders.ThreadPoolExecutor
    monkeypatch.setattr(folders, "_BLOCK", 4)
    monkeypatch.setattr(folders, "ThreadPoolExecutor", lambda threads: (pools.append(threads), pool(threads))[1])
    single = make_splits(tmp_path / "1", settings)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    four = make_splits(tmp_path / "4", settings)
    assert pools == [1, 1, 1, 4, 4, 4]
    for split in SPLITS:
        assert_equal(single[split], four[split])


@pytest.mark.parametrize("writes", [1, 9])
def test_a_killed_conversion_goes_on(tmp_path, monkeypatch, writes):
    """Images decoded before are not decoded again, and the files are equal to the byte."""
    settings = ImageSettings(size=16, minival=3, folder=make_folder(tmp_path, train=20))
    paths = paths_in(tmp_path)
    all_paths = [path for pair in paths.values() for path in pair]
    read, decoded = image_tensors.read, []
    monkeypatch.setattr(image_tensors, "read", lambda *rest: (decoded.append(rest), read(*rest))[1])
    monkeypatch.setattr(folders, "_BLOCK", 4)
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    data.make(settings, paths)
    expected, everything = {path: path.read_bytes() for path in all_paths}, len(decoded)
    for path in all_paths:
        path.unlink()

    def killed() -> None:
        write, count = Checkpoint.write, itertools.count(1)
        monkeypatch.setattr(Checkpoint, "write", lambda self: (write(self), next(count) == writes and os._exit(9)))
        data.make(settings, paths, checkpoint=Checkpoint(tmp_path / "job.pt"))

    process = multiprocessing.get_context("fork").Process(target=killed)
    process.start()
    process.join()
    assert process.exitcode == 9
    decoded.clear()
    for path in all_paths:  # as Snakemake does before it runs a job again
        path.unlink(missing_ok=True)
    data.make(settings, paths, checkpoint=Checkpoint(tmp_path / "job.pt"))
    assert {path: path.read_bytes() for path in all_paths} == expected
    assert len(decoded) == everything - 4 * writes
    assert sorted(tmp_path.glob("*.npy")) == sorted(path for path, _ in paths.values())
    assert not [path for path in files_in(tmp_path) if path.name.startswith(".")]


def test_rendered_images_replace_those_of_a_killed_conversion(tmp_path):
    """A study of a folder was killed, and then had no folder."""
    settings = ImageSettings(size=16, train=12, minival=10, test=10)
    rendered = make_splits(tmp_path, settings)
    for path, _ in paths_in(tmp_path).values():
        numpy.save(path.with_name(f".{path.name}"), numpy.zeros(1))
    again = make_splits(tmp_path, settings)
    for split in SPLITS:
        assert_equal(again[split], rendered[split])
    assert not [path for path in files_in(tmp_path) if path.name.startswith(".")]


def test_a_folder_is_known_by_its_digest(tmp_path):
    """A renamed, removed or changed image changes the digest, also behind a link; links in circles end."""
    folder = tmp_path / "linked"
    folder.symlink_to(make_folder(tmp_path / "images"))
    for link in ("here", "there"):
        (folder / "train" / "cat" / link).symlink_to(folder)
    assert folder_digest(folder) == folder_digest(folder)
    digests = {folder_digest(folder)}
    image = folder / "val" / "cat" / "1.png"
    image.rename(folder / "val" / "cat" / "2.png")
    digests.add(folder_digest(folder))
    (folder / "val" / "cat" / "2.png").unlink()
    digests.add(folder_digest(folder))
    Image.new("RGB", (64, 64)).save(folder / "val" / "dog" / "0.png")
    digests.add(folder_digest(folder))
    assert len(digests) == 4 and folder_digest(tmp_path / "nowhere") not in digests


def files_in(folder: Path) -> list[Path]:
    """Files in a folder, except lock files, which stay."""
    return sorted(path for path in folder.glob("*") if path.suffix != ".lock")


def test_a_full_disk_is_noticed_before_the_work(tmp_path, monkeypatch):
    folder = make_folder(tmp_path)
    monkeypatch.setattr(files.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1000}))
    monkeypatch.setattr(image_tensors, "read", lambda *rest: pytest.fail("an image was decoded"))
    with pytest.raises(FileError, match=r"train\.npy: needs 0\.0 MB"):
        make_splits(tmp_path / "out", ImageSettings(size=16, minival=2, folder=folder))
    assert not files_in(tmp_path / "out")


@pytest.mark.parametrize("kept, rest", [(3000, b""), (8, b"\0\0\0\0IHDR\0\0\0\0")])  # Pillow: OSError, ValueError
def test_a_damaged_image_is_named_and_nothing_is_written(tmp_path, kept, rest):
    folder = make_folder(tmp_path)
    damaged = folder / "train" / "cat" / "damaged.png"
    damaged.write_bytes((PHOTOGRAPHS / "original.png").read_bytes()[:kept] + rest)
    with pytest.raises(FileError, match=str(damaged)):
        make_splits(tmp_path / "out", ImageSettings(size=16, minival=2, folder=folder))
    assert not files_in(tmp_path / "out")


def test_rendered_images_are_the_same_on_any_number_of_cores(tmp_path):
    """Two threads sum in another order than one, which once changed a pixel in a few hundred images by a level."""
    settings, splits = ImageSettings(size=64, train=300, minival=30, test=60), []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        try:
            splits.append(make_splits(tmp_path / str(threads), settings))
        finally:
            torch.set_num_threads(1)
    for split in SPLITS:
        assert_equal(splits[0][split], splits[1][split])
