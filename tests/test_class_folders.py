"""Folders of photographs before the first job: errors are reported after a look at few of the files.

What is missing in a folder: `folders` of bad_inputs.yaml.
"""

import os
import unicodedata
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from examples import write
from PIL import Image

from tasklens.recognition import class_folders, dataset, folders
from tasklens.runtime.files import FileError
from tasklens.settings.image_settings import ImageSettings
from tasklens.settings.names import SPLITS
from tasklens.study.run import ranking_run


def images(folder, minival: int = 3, **counts) -> ImageSettings:
    return ImageSettings(size=16, minival=minival, folder=folder, **counts)


def save_photographs(folder: Path, **counts: int) -> None:
    """A folder per class with as many photographs, the k-th one with k in its red channel."""
    for name, count in counts.items():
        (folder / name).mkdir()
        for k in range(count):
            Image.new("RGB", (20, 20), (k, 0, 0)).save(folder / name / f"{k}.png")


def splits_of(settings: ImageSettings) -> dict[str, dataset.ImageDataset]:
    """The splits of a folder of photographs, written to it and read again."""
    paths = {split: tuple(settings.folder / f"{split}.{kind}" for kind in ("npy", "json")) for split in SPLITS}
    dataset.make(settings, paths)
    return {split: dataset.read(*files) for split, files in paths.items()}


@pytest.fixture
def folder(tmp_path):
    """Two classes of two training and one test image each; the files are never opened."""
    for name in ("cat", "dog"):
        for file in ("train/{}/0.png", "train/{}/deep/1.JPEG", "test/{}/0.webp"):
            write(tmp_path / file.format(name), "")
    return tmp_path


def test_a_good_folder_is_accepted(folder):
    """Also with `val` for the test images, and with other files among them."""
    write(folder / "train/labels.txt", "")
    class_folders.check(images(folder))
    (folder / "test").rename(folder / "val")
    class_folders.check(images(folder))


def test_a_large_folder_is_not_listed(folder, monkeypatch):
    """Of 400 files, only one per class and those for the minival are looked at; a million files cost nothing more."""
    for k in range(400):
        write(folder / f"train/{('cat', 'dog')[k % 2]}/{k}.jpg", "")
    seen, scandir = [], os.scandir

    @contextmanager
    def counted(path):
        with scandir(path) as entries:
            yield (seen.append(entry.name) or entry for entry in entries)

    monkeypatch.setattr(class_folders.os, "scandir", counted)
    class_folders.check(images(folder, minival=20))
    assert 21 <= sum(name.endswith(".jpg") for name in seen) < 60


@pytest.mark.parametrize(
    "names",
    [
        *[("train", "test"), ("TRAIN", "Val"), ("training", "valid"), ("Training", "TESTING"), ("train", "validation")],
        *[("train_set", "test_set"), ("Train-images", "val2017"), ("trainset", "valset")],
    ],
)
def test_splits_in_any_case_and_spelling(folder, names):
    """For every door: a study, a ranking, a design with its verdict, and the forecast; also with a word behind."""
    for old, new in zip(("train", "test"), names, strict=True):
        (folder / old).rename(folder / new)
    class_folders.check(images(folder))
    assert class_folders.is_split(folder) and class_folders.training_classes(folder) == ["cat", "dog"]
    assert (class_folders.train_folder(folder).name, class_folders.test_folder(folder).name) == names
    assert len(folders.find(class_folders.test_folder(folder), None, 0)) == 2


@pytest.mark.parametrize("names", [("train", "car"), ("valid", "invalid"), ("Test", "other"), ("validation", "bus")])
def test_a_class_may_have_the_name_of_a_split(tmp_path, names):
    """If it has no class in it, and other classes are beside it."""
    for name in names:
        write(tmp_path / name / "0.png", "")
    assert not class_folders.is_split(tmp_path)
    assert class_folders.training_classes(tmp_path) == sorted(names)


def test_splits_that_cannot_be_told_apart_are_named(folder):
    (folder / "Train").mkdir()
    with pytest.raises(FileError, match="Train and train have the name of one split; merge them"):
        class_folders.check(images(folder))


def test_a_folder_one_level_too_high_is_refused(folder):
    """By every door that reads classes, with the folder to give instead; also an undivided one with one class."""
    (folder / "deep").mkdir()
    for split in ("train", "test"):
        (folder / split).rename(folder / "deep" / split)
    for door in (
        lambda: class_folders.check(images(folder).model_copy(update={"test": 1})),
        lambda: class_folders.training_classes(folder),
        lambda: dataset.test_images(folder, 16, 10),
        lambda: dataset.training_images(images(folder), folder / "images.npy"),
        lambda: dataset.unused_images(folder, 16),
        lambda: ranking_run.image_settings(folder, 16, 10, False, False),
    ):
        with pytest.raises(FileError, match=f"but deep has train and test; give {folder}/deep$"):
            door()
    with pytest.raises(FileError, match=f"found only deep; if its folders are the classes, give {folder.name}/deep$"):
        for split in ("train", "test"):
            (folder / "deep" / split).rename(folder / "deep" / f"{split}_class")
        os.chdir(folder.parent)
        dataset.test_images(Path(folder.name), 16, 10)


def test_folders_inside_that_may_be_the_classes_are_mentioned(tmp_path, capsys):
    """Two sets beside each other; photographs of one session in a folder of its own are no reason for a line."""
    for place in ("dogs/beagle", "dogs/collie", "things/horn", "things/church"):
        write(tmp_path / place / "0.png", "")
    assert folders.find(tmp_path, None, 0).classes == ("dogs", "things")
    words = "its 2 folders are the classes; if those inside are, such as beagle, give"
    assert capsys.readouterr().err == f"tasklens: {tmp_path}: {words} {tmp_path}/dogs\n"
    write(tmp_path / "dogs" / "1.png", "")
    folders.find(tmp_path, None, 0)
    assert capsys.readouterr().err == ""


def test_links_are_followed(folder, tmp_path_factory):
    """Links to photographs, to folders in a class, and to a class; circles end, and no folder is read twice."""
    other = tmp_path_factory.mktemp("other")
    for name in ("0.png", "1.jfif", "deep/2.jpe"):
        write(other / name, "")
    cat = folder / "train/cat"
    for name, target in (("more", other), ("again", other), ("3.png", other / "0.png"), ("all", folder), ("up", cat)):
        (cat / name).symlink_to(target)
    (other / "back").symlink_to(cat)
    (cat / "itself").symlink_to("itself")
    (folder / "train/owl").symlink_to(other)
    files, others = class_folders.contents(cat)
    names = sorted(str(path.relative_to(cat)).removeprefix("more/").removeprefix("again/") for path in files)
    assert names == ["0.png", "0.png", "1.jfif", "3.png", "deep/1.JPEG", "deep/2.jpe"]
    assert others == {"links to folders that are read already": 4, "without a suffix": 1}
    assert class_folders.training_classes(folder) == ["cat", "dog", "owl"]
    assert len(class_folders.contents(folder / "train/owl")[0]) == 3  # those of the cat are not owls


def test_links_to_other_classes_are_no_photographs_of_a_class(folder):
    """And a link to a class is no class of its own."""
    (folder / "train/cat/more").symlink_to("../dog")
    files, others = class_folders.contents(folder / "train/cat")
    assert len(files) == 2 and others == {"links to folders that are read already": 1}
    (folder / "train/puppy").symlink_to("dog")
    with pytest.raises(FileError, match="puppy is a link to the folder of the class dog; remove it"):
        class_folders.training_classes(folder)


def test_what_is_passed_over_is_counted_by_kind(folder, capsys):
    """In one line for a split; hidden files do not count; a third split is not passed over in silence."""
    for name in ("cat/a.txt", "dog/deep/b.TXT", "dog/c.mp4", "README", "d.png", ".hidden", "cat/.hidden"):
        write(folder / "train" / name, "")
    class_folders.check(images(folder))
    assert len(folders.find(folder / "train", None, 0)) == 4
    words = "passed over: 1 .mp4, 2 .txt, 1 photographs in no class folder, 1 without a suffix"
    assert capsys.readouterr().err == f"tasklens: {folder}/train: {words}\n"
    folders.find(folder / "test", None, 0)
    assert capsys.readouterr().err == ""
    write(folder / "val/cat/0.png", "")
    folders.find(folder / "test", None, 0)
    assert capsys.readouterr().err == f"tasklens: {folder}/test: passed over: 1 folders beside train and test\n"


@pytest.mark.parametrize("name", ["scan.tif", "deep/PHONE.HEIC", "old.bmp"])
def test_images_of_another_kind_are_not_skipped(folder, name):
    write(folder / "train/dog" / name, "")
    with pytest.raises(FileError, match=r"train/dog/.*: expected \.jpg, .*; convert it, or remove it"):
        list(class_folders.photographs(folder / "train/dog"))


@pytest.mark.parametrize(
    "counts, words",
    [
        ({"train": 2}, "train: has 4 images, train and minival of `images` ask for 5; ask for fewer, or null for all"),
        ({"test": 3}, "test: has 2 images, test of `images` ask for 3"),
    ],
)
def test_fewer_images_than_asked_for_are_refused(folder, counts, words):
    class_folders.check(images(folder, train=1, test=2))
    with pytest.raises(FileError, match=words):
        class_folders.check(images(folder, **counts))


def test_names_of_classes_in_two_compositions(folder):
    """Names from macOS, with decomposed letters, are the same classes; both forms in one split are an error."""
    for split, form in (("train", "NFC"), ("test", "NFD")):
        (folder / split / "cat").rename(folder / split / unicodedata.normalize(form, "käse"))
    class_folders.check(images(folder))
    names = [folders.find(folder / split, None, 0).classes for split in ("train", "test")]
    assert names[0] == names[1] == ("dog", "käse")
    (folder / "train" / unicodedata.normalize("NFD", "käse")).mkdir()
    with pytest.raises(FileError, match="letters composed in two ways; merge them"):
        class_folders.check(images(folder))


def test_photographs_that_cannot_be_read_are_counted(tmp_path):
    """The message counts all and names the first ones; a single one has its own error."""
    save_photographs(tmp_path, cat=4, dog=4)
    listing = folders.find(tmp_path, None, 0)
    for spoilt, words in (
        (["cat/1.png"], r"^\S+cat/1.png: cannot be read as an image"),
        ([f"dog/{k}.png" for k in range(4)], "5 of 8 images cannot be read; .*cat/1.png.*dog/0.png.*; and 2 more$"),
    ):
        for name in spoilt:
            write(tmp_path / name, "no image")
        with pytest.raises(FileError, match=words):
            folders.convert(listing, 16, tmp_path / "a.npy", 2)
        with pytest.raises(FileError, match=words):
            folders.read_all(listing.files, 16)
    assert not (tmp_path / "a.npy").exists()


def test_a_folder_of_classes_is_cut_into_splits(tmp_path):
    """Each photograph is used once; the split without a number gets the rest."""
    save_photographs(tmp_path, cat=6, dog=6)
    settings = ImageSettings(size=16, folder=tmp_path, test=4, minival=2)
    class_folders.check(settings)
    splits = splits_of(settings)
    assert {name: len(split) for name, split in splits.items()} == {"train": 6, "minival": 2, "test": 4}
    pairs = [pair for split in splits.values() for pair in zip(split.images, split.labels, strict=True)]
    assert sorted((int(image[0, 0, 0]), int(label)) for image, label in pairs) == [(k // 2, k % 2) for k in range(12)]
    assert all(2 * int(split.labels.sum()) == len(split) for split in splits.values())
    for wrong, words in (
        ({"test": None}, "has neither train nor test; set images.test or images.train"),
        ({"test": 12}, "has 12 images; test, minival and train of `images` ask for 15"),
    ):
        with pytest.raises(FileError, match=words):
            class_folders.check(settings.model_copy(update=wrong))


def test_each_split_has_every_class_in_proportion(tmp_path):
    """A class of a tenth of the size is a tenth in every split, and in photographs held out from a design."""
    save_photographs(tmp_path, cat=60, dog=60, lynx=6)
    for split in splits_of(ImageSettings(size=16, folder=tmp_path, test=42, minival=42)).values():
        assert torch.bincount(split.labels).tolist() == [20, 20, 2]
    assert torch.bincount(dataset.unused_images(tmp_path, 16).labels).tolist() == [12, 13, 1]
