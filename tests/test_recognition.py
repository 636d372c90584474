"""Pictures, classifiers, training and evaluation."""

import copy
from itertools import pairwise

import pytest
import timm
import torch
from examples import random_pictures
from PIL import Image
from torch import nn

from tasklens.imaging import Camera
from tasklens.recognition import classifiers, data, evaluation, scenes, training
from tasklens.settings import Classifier, Images, Training
from tasklens.study import StudyError


def as_set(pictures: data.Pictures) -> set[bytes]:
    return {image.numpy().tobytes() for image in pictures.images}


# ---- built-in scenes


def test_scenes_are_balanced_and_shuffled():
    images, labels = scenes.render(53, 16, seed=1)
    assert images.shape == (53, 3, 16, 16) and images.dtype == torch.uint8
    counts = torch.bincount(labels, minlength=len(scenes.CLASSES))
    assert counts.max() - counts.min() <= 1 and counts.sum() == 53
    assert not torch.equal(labels, labels.sort().values)


def test_scenes_depend_on_the_seed_only():
    first, again, other = (scenes.render(20, 16, seed) for seed in (5, 5, 6))
    assert torch.equal(first[0], again[0]) and torch.equal(first[1], again[1])
    assert not torch.equal(first[0], other[0])


def test_means_tell_nothing_about_the_class():
    """Brightness and contrast have one distribution: class means differ by no more than chance, F(9, 590) < 3."""
    images, labels = scenes.render(600, 32, seed=2)
    values = images.float() / 255
    for feature in (values.mean((1, 2, 3)), values.mean((2, 3))[:, 0], values.std((1, 2, 3))):
        groups = [feature[labels == k] for k in range(len(scenes.CLASSES))]
        between = sum(len(g) * (g.mean() - feature.mean()) ** 2 for g in groups) / (len(groups) - 1)
        within = sum(((g - g.mean()) ** 2).sum() for g in groups) / (len(feature) - len(groups))
        assert float(between / within) < 3


def test_textures_cover_half_of_a_surface():
    """Every class paints half of its surface light: the mean sign of its signed distance is near zero."""
    u, v = 200 * torch.rand(2, 100_000, generator=torch.Generator().manual_seed(0))
    for name, texture in scenes._TEXTURES.items():
        if texture is not None:
            assert abs(float((texture(u, v) > 0).float().mean()) - 0.5) < 0.01, name


# ---- splits


def test_splits_are_disjoint_and_deterministic():
    """The minival is cut out of the training pictures; no picture stands in two splits."""
    settings = Images(size=16, train=40, minival=15, test=55, seed=3)
    splits, again = data.make(settings), data.make(settings)
    assert {name: len(part) for name, part in splits.items()} == {"train": 40, "minival": 15, "test": 55}
    seen = [as_set(part) for part in splits.values()]
    assert len(set.union(*seen)) == sum(map(len, seen)) == 110
    for name, part in splits.items():
        assert torch.equal(part.images, again[name].images) and torch.equal(part.labels, again[name].labels)
    other = data.make(settings.model_copy(update={"seed": 4}))
    assert not as_set(splits["train"]) & as_set(other["train"])
    assert not as_set(splits["test"]) & as_set(other["train"])


def test_pictures_survive_their_file(tmp_path):
    pictures = random_pictures(6, 16, 3, seed=0)
    data.write(pictures, tmp_path / "train.safetensors")
    found = data.read(tmp_path / "train.safetensors")
    assert torch.equal(found.images, pictures.images) and torch.equal(found.labels, pictures.labels)
    assert found.classes == pictures.classes


def make_folder(root, train=4, test=2, test_name="val", classes=("cat", "dog")):
    """Pictures of one grey per file: 10, 20, ... for cats, 110, 120, ... for dogs; tests are one brighter."""
    for split, count in (("train", train), (test_name, test)):
        for k, name in enumerate(classes):
            (root / split / name).mkdir(parents=True)
            for i in range(count):
                value = 100 * k + 10 * (i + 1) + (split != "train")
                Image.new("RGB", (20, 30), (value,) * 3).save(root / split / name / f"{i}.png")
    return root


def test_folder_of_photographs(tmp_path):
    """train/ and val/ with a folder per class; every picture keeps its class, minival and train stay apart."""
    splits = data.make(Images(size=16, minival=3, folder=make_folder(tmp_path)))
    assert {name: len(part) for name, part in splits.items()} == {"train": 5, "minival": 3, "test": 4}
    for name, part in splits.items():
        assert part.classes == ("cat", "dog") and part.images.shape[1:] == (3, 16, 16)
        greys = part.images[:, 0, 0, 0].long()
        assert torch.equal((greys > 100).long(), part.labels), name
        assert ((greys % 10 == 1) == (name == "test")).all()
    assert not as_set(splits["train"]) & as_set(splits["minival"])


def test_counts_limit_a_folder_evenly(tmp_path):
    splits = data.make(Images(size=16, train=2, minival=2, test=2, folder=make_folder(tmp_path, test_name="test")))
    assert torch.bincount(torch.cat([splits["train"].labels, splits["minival"].labels])).tolist() == [2, 2]
    assert torch.bincount(splits["test"].labels).tolist() == [1, 1]


@pytest.mark.parametrize(
    "mode, colour", [("L", 77), ("RGBA", (77, 77, 77, 255)), ("P", 77), ("1", 1), ("CMYK", (0,) * 4)]
)
def test_any_kind_of_picture_becomes_rgb(tmp_path, mode, colour):
    folder = make_folder(tmp_path)
    picture = Image.new(mode, (24, 24), colour)
    picture.save(folder / "train" / "cat" / ("more.jpg" if mode == "CMYK" else "more.png"))
    expected = picture.convert("RGB").getpixel((0, 0))
    splits = data.make(Images(size=16, minival=1, folder=folder))
    images = torch.cat([splits["train"].images, splits["minival"].images])
    assert images.shape == (9, 3, 16, 16)
    assert (images == torch.tensor(expected)[:, None, None]).flatten(1).all(1).any()


def test_sixteen_bits_are_scaled(tmp_path):
    """Half of full scale stays half of full scale."""
    folder = make_folder(tmp_path)
    Image.new("I;16", (16, 16), 30000).save(folder / "val" / "cat" / "deep.png")
    test = data.make(Images(size=16, minival=1, folder=folder))["test"]
    assert (test.images.flatten(1).int() - 30000 * 255 // 65535).abs().max(1).values.min() <= 1


def test_the_central_square_is_kept(tmp_path):
    """A picture of 30 x 10 pixels with white ends becomes its black middle."""
    folder = make_folder(tmp_path)
    wide = Image.new("RGB", (60, 20), "white")
    wide.paste((0, 0, 0), (15, 0, 45, 20))
    wide.save(folder / "val" / "cat" / "wide.png")
    test = data.make(Images(size=16, minival=1, folder=folder))["test"]
    assert (test.images.flatten(1) == 0).all(1).sum() == 1


def spoil_missing(folder):
    for path in sorted((folder / "val").rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    (folder / "val").rmdir()
    return str(folder), "val"


def spoil_empty(folder):
    (folder / "train" / "axolotl").mkdir()
    return (str(folder / "train" / "axolotl"),)


def spoil_text(folder):
    path = folder / "train" / "cat" / "text.png"
    path.write_text("not a picture")
    return (str(path),)


def spoil_truncated(folder):
    path = folder / "train" / "cat" / "cut.png"
    noise = torch.randint(0, 256, (64, 64, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    Image.fromarray(noise.numpy()).save(path)
    path.write_bytes(path.read_bytes()[:3000])
    return (str(path),)


def spoil_classes(folder):
    (folder / "val" / "dog").rename(folder / "val" / "wolf")
    return str(folder), "dog", "wolf"


@pytest.mark.parametrize("spoil", [spoil_missing, spoil_empty, spoil_text, spoil_truncated, spoil_classes])
def test_a_bad_folder_is_named(tmp_path, spoil):
    folder = make_folder(tmp_path)
    words = spoil(folder)
    with pytest.raises(StudyError) as error:
        data.make(Images(size=16, minival=1, folder=folder))
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize("folder, key", [("nowhere", "images.folder"), (None, "images.minival")])
def test_a_folder_that_cannot_serve(tmp_path, folder, key):
    """No such folder; or fewer pictures than the minival wants."""
    path = tmp_path / folder if folder else make_folder(tmp_path)
    with pytest.raises(StudyError) as error:
        data.make(Images(size=16, minival=8, folder=path))
    assert key in str(error.value)


# ---- classifiers


@pytest.mark.parametrize(
    "model, arguments, size",
    [("resnt18", {}, 64), ("resnet18", {"chanels": [8]}, 64), ("vit_tiny_patch16_224", {"img_size": 64}, 80)],
)
def test_a_network_that_cannot_be_built_is_a_mistake_in_the_study(model, arguments, size):
    """An unknown model, an unknown argument, pictures of another size than the network's: before any weight is made."""
    classifier = Classifier(model=model, arguments=arguments, training=Training(epochs=1, rate=1e-3))
    with pytest.raises(StudyError, match=f"classifiers.mine: {model}"):
        classifiers.check("mine", classifier, size)
    classifiers.check("mine", Classifier(model="resnet18", pretrained=True), 64)


def test_a_published_head_for_other_classes_is_no_reference():
    """Without training it would judge at random; found before anything is downloaded."""
    with pytest.raises(StudyError, match="1000 classes, the pictures have 10"):
        classifiers.build(Classifier(model="resnet18.a1_in1k", pretrained=True), 10)


@pytest.mark.parametrize("model", ["resnet18", "vit_tiny_patch16_224.augreg_in21k_ft_in1k"])
def test_classifier_normalises_after_the_optics(model):
    """Logits of pictures in [0, 1] are those of the timm network on (x - mean) / std of its own configuration."""
    if model.startswith("vit"):
        small = {"img_size": 32, "embed_dim": 12, "depth": 1}
    else:
        small = {"layers": [1, 1, 1, 1], "channels": [8, 8, 8, 8]}
    torch.manual_seed(0)
    classifier = Classifier(model=model, arguments=small, training=Training(epochs=1, rate=1e-3))
    recogniser = classifiers.build(classifier, 7).eval()
    torch.manual_seed(0)
    network = timm.create_model(model, num_classes=7, **small).eval()
    config = timm.data.resolve_model_data_config(network)
    images = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    mean, std = (torch.tensor(config[k])[:, None, None] for k in ("mean", "std"))
    with torch.no_grad():
        torch.testing.assert_close(recogniser(images), network((images - mean) / std), rtol=1e-5, atol=1e-6)
    assert (config["mean"] == (0.5, 0.5, 0.5)) == model.startswith("vit")
    assert set(recogniser.network.state_dict()) == set(network.state_dict())
    assert classifiers.parameters_m(recogniser) == sum(p.numel() for p in network.parameters()) / 1e6


def test_weights_of_a_file_replace_all_others(tmp_path):
    from tasklens.files import write_tensors

    classifier = Classifier(model="test_resnet", training=Training(epochs=1, rate=1e-3))
    first = classifiers.build(classifier, 4).eval()
    path = tmp_path / "weights.safetensors"
    write_tensors(path, first.network.state_dict(), {})
    second = classifiers.build(classifier, 4, path).eval()
    images = torch.rand(2, 3, 32, 32)
    assert torch.equal(first(images), second(images))
    with pytest.raises(RuntimeError, match="size mismatch"):
        classifiers.build(classifier, 5, path)


@pytest.mark.parametrize("model", ["test_resnet", "test_efficientnet", "test_vit"])
def test_a_frozen_copy_judges_alike_and_remembers_less(model):
    """Same logits and gradients at the pictures; convolutional networks keep at most 0.7 of the memory for them."""
    torch.manual_seed(0)
    recogniser = classifiers.Recogniser(timm.create_model(model, num_classes=5)).double()
    for module in recogniser.modules():
        if isinstance(module, nn.BatchNorm2d):  # as after training: statistics that do something
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.running_mean, std=0.1)
            nn.init.uniform_(module.running_var, 0.5, 1.5)
    size = recogniser.network.pretrained_cfg["input_size"][-1]
    images = torch.rand(2, 3, size, size, dtype=torch.float64)
    frozen, found = classifiers.frozen(recogniser), []
    assert recogniser.training and all(p.requires_grad for p in recogniser.parameters())
    assert not frozen.training and not any(p.requires_grad for p in frozen.parameters())
    for network in (frozen, recogniser.eval().requires_grad_(False)):
        kept: dict[int, int] = {}

        def keep(tensor, kept=kept):
            kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        leaf = images.clone().requires_grad_()
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            logits = network(leaf)
        logits.square().sum().backward()
        found.append((logits.detach(), leaf.grad, sum(kept.values())))
    for a, b in zip(found[0][:2], found[1][:2], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)
    assert found[0][2] <= (1.0 if model == "test_vit" else 0.7) * found[1][2]


# ---- training


def small_network(seed: int) -> nn.Module:
    torch.manual_seed(seed)
    layers = nn.Conv2d(3, 8, 3, stride=2), nn.BatchNorm2d(8), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten()
    return nn.Sequential(*layers, nn.Dropout(0.1), nn.Linear(8, 3))


def trained(seed: int, **settings) -> nn.Module:
    network = small_network(0)
    settings = Training(**({"epochs": 4, "rate": 1e-2, "batch": 10} | settings))
    training.fit(network, random_pictures(60, 16, 3, seed=1), settings, seed, "test")
    return network


def test_training_is_deterministic():
    """One seed, one result to the last bit; another seed, another."""
    first, again, other = (trained(seed).state_dict() for seed in (4, 4, 5))
    assert all(torch.equal(first[k], again[k]) for k in first)
    assert not torch.equal(first["0.weight"], other["0.weight"])


def test_training_learns_and_ends_in_eval():
    network = trained(0, epochs=20)
    assert not network.training
    correct, _ = evaluation.evaluate(network, random_pictures(60, 16, 3, seed=2), evaluation.Sight())
    assert correct.double().mean() > 0.9


def test_what_the_classifier_sees_is_what_it_learns_from():
    """`see` gets the flipped pictures in [0, 1]; training on black pictures cannot learn."""
    network, pictures = small_network(0), random_pictures(60, 16, 3, seed=1)
    ranges = []

    def see(images, generator):
        ranges.append((float(images.min()), float(images.max())))
        return 0 * images

    training.fit(network, pictures, Training(epochs=20, rate=1e-2, batch=10), 0, "test", see)
    assert len(ranges) == 120 and all(0 <= low < high <= 1 for low, high in ranges)
    correct, _ = evaluation.evaluate(network, pictures, evaluation.Sight())
    assert correct.double().mean() < 0.5


def test_a_loss_that_is_not_finite_ends_the_training():
    with pytest.raises(FloatingPointError, match="step 1 of"):
        network = small_network(0)
        nn.init.constant_(network[-1].bias, float("nan"))
        training.fit(network, random_pictures(60, 16, 3, seed=1), Training(epochs=1, rate=1e-2), 0, "test")


def test_weight_decay_spares_vectors():
    groups = training.parameter_groups(small_network(0), 0.05)
    decay = {p.ndim > 1: group["weight_decay"] for group in groups for p in group["params"]}
    assert decay == {True: 0.05, False: 0.0}
    assert sum(len(group["params"]) for group in groups) == len(list(small_network(0).parameters()))


def test_rate_rises_linearly_and_falls_on_a_cosine():
    optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule, rates = training.warmup_cosine(optimizer, 100, 0.1), []
    for _ in range(100):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert rates[:10] == pytest.approx([k / 11 for k in range(1, 11)])
    assert rates[10] == max(rates) == pytest.approx(1)
    assert rates[55] == pytest.approx(0.5) and 0 < rates[-1] < 1e-3
    assert all(a > b for a, b in pairwise(rates[10:]))


def test_every_picture_is_used_before_any_repeats():
    batches = list(training.shuffled(10, 4, 5, torch.Generator().manual_seed(0)))
    assert [len(b) for b in batches] == [4] * 5
    assert torch.cat(batches)[:10].sort().values.tolist() == torch.cat(batches)[10:].sort().values.tolist()
    assert torch.cat(batches)[:10].sort().values.tolist() == list(range(10))


# ---- evaluation


class Brightness(nn.Module):
    """Sorts pictures into dark, medium and bright by their mean."""

    def forward(self, images):
        return -(images.mean((1, 2, 3))[:, None] - torch.tensor([0.1, 0.5, 0.9])).abs()


def grey_pictures(values, labels) -> data.Pictures:
    images = torch.tensor(values, dtype=torch.uint8)[:, None, None, None].expand(-1, 3, 16, 16).contiguous()
    return data.Pictures(images, torch.tensor(labels), ("dark", "medium", "bright"))


def test_evaluation_against_a_hand_count():
    """Four of five grey pictures are sorted as labelled; without a camera there is one field and no error."""
    pictures = grey_pictures([10, 130, 240, 20, 120], [0, 1, 2, 2, 1])
    correct, quality = evaluation.evaluate(Brightness(), pictures, evaluation.Sight())
    assert correct.tolist() == [[True, True, True, False, True]]
    assert quality.shape == (1, 5)
    rows, by_picture = evaluation.measure(
        Brightness(), {"test": pictures, "minival": pictures.take(torch.tensor([3, 4]))}, evaluation.Sight()
    )
    assert [row["field0"] for row in by_picture] == [1, 1, 1, 0, 1]
    found = {(row["field"], row["metric"]): row["value"] for row in rows}
    assert found.pop((0, "accuracy")) == pytest.approx(80)
    assert found.pop((0, "minival_accuracy")) == pytest.approx(50)
    assert found.pop(("", "chance")) == pytest.approx(100 / 3)
    assert found.pop(("", "parameters_m")) == 0
    assert not found


def dimming(factors) -> Camera:
    """A camera whose fields scale the brightness: no lens does, but everything can be counted by hand."""
    grid = torch.zeros(len(factors), 3, 3, 3)
    grid[..., 1, 1] = torch.tensor(factors)[:, None]
    camera = Camera(grid)
    camera.veil.zero_()
    return camera


def test_every_field_is_evaluated_on_every_picture():
    """Field 1 halves the light: 240 is taken for medium there, and 120 for dark."""
    pictures = grey_pictures([10, 240, 120] * 30, [0, 2, 1] * 30)
    correct, quality = evaluation.evaluate(Brightness(), pictures, evaluation.Sight(dimming([1.0, 0.5])))
    assert correct.shape == quality.shape == (2, 90)
    assert correct.double().mean(1).tolist() == pytest.approx([1, 1 / 3])
    expected = -20 * torch.log10(torch.tensor([5, 120, 60]) / 255)
    torch.testing.assert_close(quality[1, :3], expected, rtol=0, atol=1e-3)
    rows, by_picture = evaluation.measure(
        Brightness(), {"test": pictures, "minival": pictures}, evaluation.Sight(dimming([1.0, 0.5]))
    )
    assert by_picture[:3] == [
        {"picture": 0, "label": "dark", "field0": 1, "field1": 1},
        {"picture": 1, "label": "bright", "field0": 1, "field1": 0},
        {"picture": 2, "label": "medium", "field0": 1, "field1": 0},
    ]
    assert [row["field"] for row in rows if row["metric"] == "psnr_db"] == [0, 1]
    worst = [row["value"] for row in rows if row["metric"] == "worst_psnr_db"]  # the one brightest of 90
    assert worst[1] == pytest.approx(float(expected[1]), abs=1e-3) and len(worst) == 2


def test_restoration_stands_between_camera_and_classifier():
    """A restoration that doubles the light undoes a camera that halves it."""

    class Double(nn.Module):
        def forward(self, captures):
            return 2 * captures

    pictures = grey_pictures([10, 240, 120], [0, 2, 1])
    sight = evaluation.Sight(dimming([0.5, 0.5]), Double())
    correct, quality = evaluation.evaluate(Brightness(), pictures, sight)
    assert correct.all() and (quality > 80).all()
    seen = sight.one_field(pictures.batch(torch.arange(3))[0], torch.Generator().manual_seed(0))
    torch.testing.assert_close(seen, pictures.images.float() / 255, rtol=0, atol=1e-6)


def test_training_sees_a_random_field_per_picture():
    """Over many pictures each field is seen about equally often, drawn by the generator alone."""
    sight, images = evaluation.Sight(dimming([0.1, 0.2, 0.3, 0.4])), torch.ones(400, 3, 4, 4)
    seen = [sight.one_field(images, torch.Generator().manual_seed(s)).mean((1, 2, 3)) for s in (0, 0, 1)]
    assert torch.equal(seen[0], seen[1]) and not torch.equal(seen[0], seen[2])
    counts = torch.bincount((10 * seen[0]).round().long(), minlength=5)[1:]
    assert counts.sum() == 400 and counts.min() > 60


def test_the_worst_pictures_are_one_in_a_hundred():
    """Of 250 pictures of as many greys, halved in brightness, the three brightest lose most."""
    pictures = grey_pictures(list(range(1, 251)), [0] * 250)
    rows, _ = evaluation.measure(
        Brightness(), {"test": pictures, "minival": pictures}, evaluation.Sight(dimming([0.5]))
    )
    found = next(row["value"] for row in rows if row["metric"] == "worst_psnr_db")
    lost = -20 * torch.log10(torch.tensor([124.0, 124.5, 125.0]) / 255)
    assert found == pytest.approx(float(lost.mean()), abs=1e-3)


def test_batch_norms_of_a_frozen_network_by_the_batch():
    """Captures of half the contrast give what the whole gives; nothing stored changes, and no weight has a gradient."""
    recogniser = trained(0)
    before = copy.deepcopy(recogniser.state_dict())
    frozen = classifiers.frozen(recogniser, "batch")
    images, _ = random_pictures(12, 16, 3, seed=1).batch(torch.arange(12))
    images.requires_grad_()
    whole, faint = frozen(images), frozen(0.5 * images + 0.25)
    assert float((whole - faint).abs().max()) < 0.05 * float(whole.abs().max())
    stored = classifiers.frozen(recogniser)
    assert float((stored(images) - stored(0.5 * images + 0.25)).abs().max()) > 0.2 * float(whole.abs().max())
    whole.sum().backward()
    assert images.grad.abs().max() > 0 and all(p.grad is None for p in frozen.parameters())
    state = frozen.state_dict()
    assert all(torch.equal(v, before[k]) for k, v in state.items() if "num_batches" not in k)


def test_evaluation_changes_nothing():
    """Neither batch statistics nor weights move while a classifier is measured."""
    network = trained(0)
    before = copy.deepcopy(network.state_dict())
    evaluation.evaluate(network, random_pictures(20, 16, 3, seed=2), evaluation.Sight())
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
