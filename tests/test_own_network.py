"""A lens designed in Python for the user's module, images and loss."""

import copy
from types import SimpleNamespace

import pytest
import timm
import torch
from examples import HEADLINE, random_images, small_network, trained_resnet
from torch import nn
from torch.nn.functional import cross_entropy, mse_loss
from torch.utils.data import DataLoader, Subset

import tasklens
from tasklens.api.design import verdict
from tasklens.design import objective
from tasklens.design.single import BASELINES, LensRequest, designs
from tasklens.recognition import classifiers
from tasklens.recognition import pairs as labelled
from tasklens.recognition.classifiers import Classifier
from tasklens.recognition.dataset import ImageDataset
from tasklens.recognition.sharp import check_accuracy
from tasklens.recognition.training import fit
from tasklens.runtime.errors import InputError
from tasklens.settings.network_settings import TrainingSettings

LENS = HEADLINE / "doublet-imaging3.yaml"
PLATES = {"start": "flat", "batch_size": 4, "rays": 16}
QUICK = PLATES | {"descents": [{"steps": 2, "pixels": [20, 5]}, {"steps": 2, "pixels": [5, 1]}]}
SPEC = {"kernel_size": 11}
pytestmark = pytest.mark.usefixtures("few_rays")


@pytest.fixture(scope="module")
def images():
    return random_images(24, 32, 3, seed=0)


@pytest.fixture(scope="module")
def network(images):
    torch.manual_seed(0)
    classifier = small_network(0)
    fit(classifier, images, TrainingSettings(epochs=12, learning_rate=1e-2, batch_size=8), 0, "test")
    classifier.zero_grad()
    return classifier


def pairs(images):
    """Pairs of an image in floating point and a label, as in a torch data set."""
    return [(image.float() / 255, label) for image, label in zip(images.images, images.labels.tolist(), strict=True)]


def test_a_module_and_pairs_of_images_design_a_lens(images, network, capsys):
    """The same lens as for a data set of ours; the module and its gradients are as before."""
    before = {name: value.clone() for name, value in network.state_dict().items()}
    lenses = [
        tasklens.design_lens("task", ["COC"], images=data, network=network, settings=QUICK, **SPEC)[0]
        for data in (pairs(images), images)
    ]
    assert torch.equal(lenses[0].curvature, lenses[1].curvature) and lenses[0].curvature.any()
    assert all(torch.equal(before[name], value) for name, value in network.state_dict().items())
    assert all(parameter.grad is None for parameter in network.parameters())
    assert "of 24 sharp images (guessing: 33.3%)" in capsys.readouterr().err


def test_a_loss_of_ones_own(images):
    """Regression of the brightness, by a network that is no classifier; the loss falls."""

    class Mean(nn.Module):
        def forward(self, captures):
            return captures.mean((1, 2, 3)), captures.std((1, 2, 3))

    options = {"images": pairs(images), "network": Mean(), "loss": lambda answer, labels: -answer[1]}
    lens, _, notes = tasklens.design_lens("task", ["COC"], settings=QUICK, **options, **SPEC)
    assert lens.curvature.any() and notes["origin"]["validation_loss"] < 0


@pytest.mark.parametrize(
    "change, words",
    [
        ({"temperature": 2}, "temperature: only for the loss of a classifier"),
        ({"corner_weight": 4}, "a number for each"),
    ],
)
def test_settings_that_a_loss_cannot_have_are_refused(images, network, change, words):
    options = {"images": images, "network": network, "loss": cross_entropy}
    settings = {**QUICK, "descents": [{**QUICK["descents"][0], **change}, QUICK["descents"][1]]}
    with pytest.raises(InputError, match=words):
        tasklens.design_lens("task", ["COC"], settings=settings, **options, **SPEC)


TRAINING = {"steps": 2, "pixels": [5, 1], "network_learning_rate": 1e-2}


def test_joint_design_trains_the_network(images, network):
    """In place, with its own names of parameters; the frozen method leaves it alone (above)."""
    mine = copy.deepcopy(network)
    settings = PLATES | {"descents": [TRAINING]}
    result = designs(LensRequest("joint", ["COC"], images=images, network=mine, settings=settings, spec=SPEC))
    assert all(torch.equal(value, mine.state_dict()[name]) for name, value in network.state_dict().items())
    tasklens.design_lens("joint", ["COC"], images=images, network=mine, settings=settings, **SPEC)
    weights = mine.state_dict()
    assert all(torch.equal(value, result.trained_weights[name]) for name, value in weights.items())
    assert any(not torch.equal(value, weights[name]) for name, value in network.state_dict().items())


def test_joint_design_keeps_frozen_parameters(images, network):
    """As torch does: what requires no gradient is not trained; if that is everything, joint design is refused."""
    mine = copy.deepcopy(network)
    mine[0].requires_grad_(False)
    options = {"images": images, "settings": PLATES | {"descents": [TRAINING]}, **SPEC}
    tasklens.design_lens("joint", ["COC"], network=mine, **options)
    assert torch.equal(mine[0].weight, network[0].weight) and not torch.equal(mine[-1].weight, network[-1].weight)
    with pytest.raises(InputError, match="no parameter requires a gradient"):
        tasklens.design_lens("joint", ["COC"], network=mine.requires_grad_(False), **options)


def test_networks_with_views_and_with_named_logits(images, network):
    """As in many tutorials: the network flattens by `view`, and wraps its logits."""

    class Views(nn.Sequential):
        def forward(self, images: torch.Tensor) -> SimpleNamespace:
            features = nn.Sequential(*[*self][:3])(images)
            return SimpleNamespace(logits=self[-1](features.view(len(images), 8, -1).mean(-1)))

    options = {"images": images, "network": Views(*network), "settings": QUICK}
    assert tasklens.design_lens("task", ["COC"], **options, **SPEC)[0].curvature.any()


@pytest.mark.parametrize(
    "labels, words",
    [
        (torch.tensor([1, 2, 3]), "labels from 0 to 2, numbers of 3 classes, got 1 to 3"),
        (torch.tensor([True, False, True]), "integers from 0, got torch.bool"),
        (torch.eye(3, dtype=torch.long), r"integers from 0, got torch.int64 of shape \(3,\)"),
    ],
)
def test_labels_that_are_no_classes_are_refused(images, network, labels, words):
    """By a design and by a ranking."""
    dataset = ImageDataset(images.images[:3], labels, images.classes)
    with pytest.raises(InputError, match=words):
        tasklens.design_lens("task", ["COC"], images=dataset, network=network, settings=QUICK, **SPEC)
    with pytest.raises(InputError, match=words):
        tasklens.rank({"a": tasklens.load_lens(LENS)}, dataset, network)


def test_labels_may_be_of_any_type_of_integer(images):
    """As numpy's, of which torch's losses take only some."""
    labels = images.labels.numpy().astype("int16")
    dataset = labelled.of_pairs(list(zip(images.images, labels, strict=True)))
    assert dataset.labels.dtype == torch.int64 and torch.equal(dataset.labels, images.labels)


def test_images_are_not_augmented_with_a_loss(images, network, monkeypatch):
    """Positions and masks would not move with them."""

    monkeypatch.setattr(objective, "TrivialAugmentWide", lambda: pytest.fail("augmented"))
    settings = {"descents": {"0": {"steps": 1}}, "batch_size": 2}
    options = {"images": images, "network": network, "loss": cross_entropy, "start": tasklens.load_lens(LENS)}
    tasklens.design_lens("end_to_end", settings=settings, **options)
    with pytest.raises(pytest.fail.Exception):
        tasklens.design_lens("end_to_end", settings=settings | {"augment": True}, **options)


def test_labels_may_be_tensors(images):
    """For a custom loss: here the network is to return three given numbers for each image."""
    generator = torch.Generator().manual_seed(0)
    labelled = [(image.float() / 255, torch.rand(3, generator=generator)) for image in images.images[:12]]

    options = {"images": labelled, "network": small_network(0), "settings": QUICK, **SPEC}
    lens, _, _ = tasklens.design_lens("task", ["COC"], loss=mse_loss, **options)
    assert lens.curvature.any()
    with pytest.raises(InputError, match="a design takes others with a `loss`"):
        tasklens.design_lens("task", ["COC"], **options)
    with pytest.raises(InputError, match="loss: expected a tensor"):
        tasklens.design_lens("task", ["COC"], loss=lambda answer, target: 0.5, **options)


TRAINED = nn.Parameter(torch.ones(()))


@pytest.mark.parametrize(
    "network, loss, words",
    [
        (nn.Linear(7, 3), None, r"network: fails for images \(2, 3, 32, 32\) of torch.float32: .*mat1 and mat2"),
        (nn.Flatten().forward, None, "network: expected a torch.nn.Module or its settings, got method"),
        (nn.Conv2d(3, 3, 3), None, r"a tensor \(2, 3, 30, 30\) for 2 images of 3 classes; expected logits \(2, 3\)"),
        (nn.Flatten(), lambda answer, labels: answer, r"loss: expected one number or one for each image, got a tensor"),
        (
            nn.Flatten(),
            lambda answer, labels: answer.detach().sum(),
            "loss: has no gradient with respect to the images",
        ),
        (nn.Flatten(), lambda answer, labels: TRAINED * answer.detach().sum(), "loss: has no gradient with respect"),
        (nn.Flatten(), mse_loss, "loss: fails for the answers to 2 images: The size of tensor"),
        (nn.Flatten(), lambda answer, labels: answer.sum() / 0, "loss: expected a finite number"),
    ],
)
def test_what_cannot_be_used_is_refused_before_the_first_step(images, network, loss, words):
    with pytest.raises(InputError, match=words):
        tasklens.design_lens("task", ["COC"], images=images, network=network, loss=loss, settings=QUICK, **SPEC)


def test_labels_that_are_images_are_not_augmented(images):
    """Augmentation would move the image and not its mask."""
    pairs_of_masks = [(image.float() / 255, image[:1].float()) for image in images.images[:12]]
    options = {"images": pairs_of_masks, "network": nn.Conv2d(3, 1, 1), "loss": mse_loss, **SPEC}
    with pytest.raises(InputError, match="augment: it shifts and turns images, but not labels"):
        tasklens.design_lens("task", ["COC"], settings=QUICK | {"augment": True}, **options)
    part = {"steps": 1, "pixels": [5, 1], "size": 24}
    with pytest.raises(InputError, match="size: labels of images"):
        tasklens.design_lens("task", ["COC"], settings=PLATES | {"descents": [part]}, **options)


def test_a_part_of_a_data_set_has_its_classes(images):
    """torch's `Subset`, in which a class has no image; a network with more outputs than classes is accepted."""

    class Data(list):
        classes = ("a", "b", "c")

    part = Subset(Data(pair for pair in pairs(images) if pair[1] < 2), range(10))
    assert labelled.of_pairs(part).classes == Data.classes and len(labelled.of_pairs(part, 7)) == 7
    with pytest.raises(InputError, match="got a DataLoader; give its"):
        labelled.of_pairs(DataLoader(part))
    classifiers.check_logits(torch.rand(2, 5, requires_grad=True), 2, 3, exactly=False)


def test_a_timm_network_says_how_it_normalises(images, capsys):
    """And stays as it is."""
    network = timm.create_model("test_resnet", num_classes=3)
    strides = [parameter.stride() for parameter in network.parameters()]
    classifier = classifiers.of_user(network)
    assert "normalised by the network's pretrained_cfg, with mean [0.5, 0.5, 0.5]" in capsys.readouterr().err
    assert [parameter.stride() for parameter in network.parameters()] == strides
    classifiers.of_user(nn.Sequential(network))
    network.last = network(torch.rand(2, 3, 32, 32))
    with pytest.raises(InputError, match="network: cannot be copied"):
        classifiers.of_user(nn.Sequential(network))
    assert float(classifier.mean[0]) == 0.5 and capsys.readouterr().err == ""


def test_wrong_pairs_are_refused(network):
    good = (torch.rand(3, 32, 32), 0)
    for data, words in (
        ([good, (torch.rand(3, 30, 30), 1)], "images: expected one size"),
        ([good, (torch.rand(1, 32, 32), 1)], "images: number 1: expected a pair"),
        ([good, (torch.rand(3, 32, 32), "cat")], "images: number 1: expected a pair"),
        ([good, (torch.rand(3, 32, 32), [0, 1])], "images: expected labels of one shape"),
        ([], "got none"),
        (7, "images: expected a folder, or pairs"),
    ):
        with pytest.raises(InputError, match=words):
            tasklens.design_lens("task", ["COC"], images=data, network=network, settings=QUICK, **SPEC)


def test_a_network_that_cannot_be_told_from_guessing_is_refused(images):
    with pytest.raises(InputError, match="the network has one output"):
        check_accuracy(lambda batch: batch.mean((1, 2, 3))[:, None], images)
    with pytest.raises(InputError, match=r"of 2 sharp images \(guessing: 33.3%\): too few images to tell"):
        check_accuracy(small_network(0), images.take(torch.arange(2)))


def test_pairs_of_images_with_a_network_by_name(images, tmp_path):
    """It has as many outputs as these images have classes."""
    weights = trained_resnet(tmp_path / "mine.safetensors", images, epochs=10, batch_size=8)
    by_name = {"model": "test_resnet", "weights": str(weights)}
    lens, _, _ = tasklens.design_lens("task", ["COC"], images=images, network=by_name, settings=QUICK, **SPEC)
    assert lens.curvature.any()
    with pytest.raises(InputError, match="network: joint trains it with the lens; give"):
        tasklens.design_lens("joint", ["COC"], images=images, network=by_name, **SPEC)


def test_unused_outputs_of_a_module_that_is_not_of_timm():
    """A module does not declare its outputs: if only some are used, it has those of ImageNet's thousand classes."""
    network = nn.Linear(3, 1000)
    assert Classifier(network, torch.tensor([3, 7])).has_more_outputs
    assert not Classifier(network, torch.arange(1000)).has_more_outputs and not Classifier(network).has_more_outputs


@pytest.mark.slow
def test_a_verdict_names_the_best_lens_for_image_quality(images, network):
    """With the same candidate starts and number of steps; better or worse only if the interval says so."""
    request = LensRequest("task", ["COC"], images=images, network=network, settings=QUICK, spec=SPEC)
    result = designs(request, baselines=BASELINES)
    assert list(result.lenses) == ["log_image_error", "correlation", "task"]
    assert not torch.equal(result.lenses["task"].curvature, result.lenses["correlation"].curvature)
    words, ranking = verdict(result, random_images(30, 32, 3, seed=1))
    accuracy = ranking.table.set_index("lens")["accuracy"]
    assert set(accuracy.index) == set(result.lenses)
    assert f"recognises {accuracy['task']:.1f} % through this lens" in words and "On 30 photographs" in words
    assert any(f"({name}, chosen on photographs" in words for name in BASELINES)
