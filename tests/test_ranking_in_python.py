"""Lenses are ranked in Python by a module and images in memory, and the result is a table."""

import pytest
import torch
from typed_lenses import singlet

import tasklens
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError


class Answers(torch.nn.Module):
    """A network that returns what a function makes of the images."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, images: torch.Tensor):
        return self.function(images)


def test_outputs_of_imagenet_in_python():
    """As in the command: classes by their WordNet ids, alone or among all; an unknown word and other outputs fail."""
    names = ("n01440764", "n01514668", "n02102040")  # in ImageNet's order 0, 7 and 217

    class Photographs(list):
        classes = names

    def answers(other: float):
        """Logits of brightness for these classes, and one for another class."""

        def logits(images):
            values = torch.full((len(images), 1000), -9.0)
            values[:, [0, 7, 217]] = -(images.mean((2, 3)) - 0.3 * torch.arange(3.0)).square()
            values[:, 500] = other
            return values

        return Answers(logits)

    data = Photographs([(torch.full((3, 32, 32), 0.3 * k), k) for k in range(3)] * 10)
    lenses, options = {"mine": singlet()}, {"rays": 64}
    for other, outputs in ((1.0, "imagenet"), (-9.0, "all_imagenet")):
        assert tasklens.rank(lenses, data, answers(other), outputs=outputs, **options).sharp == 100
    for outputs in ("classes", "all_imagenet"):
        with pytest.raises(InputError, match="no better than guessing"):
            tasklens.rank(lenses, data, answers(1.0), outputs=outputs, **options)
    with pytest.raises(InputError, match="outputs: expected classes, imagenet, all_imagenet, got 'all'"):
        tasklens.rank(lenses, data, answers(1.0), outputs="all", **options)
    with pytest.raises(InputError, match="expected logits of the 1000 classes of ImageNet"):
        tasklens.rank(lenses, data, Answers(lambda images: images.mean((2, 3))), outputs="imagenet", **options)
    data.classes = ("cat", "dog", "owl")
    with pytest.raises(FileError, match="expected folders named by WordNet ids"):
        tasklens.rank(lenses, data, answers(1.0), outputs="imagenet", **options)


@pytest.mark.parametrize(
    "network, words",
    [
        (Answers(lambda images: (images.mean((2, 3)), None)), "returns a tuple; expected a tensor of logits"),
        (torch.nn.Conv2d(3, 2, 3), "returns a tensor"),
        (torch.mean, "expected a torch.nn.Module, got builtin"),
        (Answers(lambda images: images.tolist().index(3)), "fails for images"),
        (torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(7, 2)), r"fails for images \(3, 32, 32\): .*mat1"),
        (torch.nn.Sequential(torch.nn.Conv2d(3, 2, 3), torch.nn.BatchNorm2d(5)), r"fails for images \(3, 32, 32\): "),
        (Answers(lambda images: torch.nan * images.mean((2, 3))), "logits that are not finite"),
    ],
)
def test_a_network_that_returns_no_logits_ranks_nothing(network, words):
    pairs = [(torch.rand(3, 32, 32), k) for k in (0, 1)]
    with pytest.raises(InputError, match=words):
        tasklens.rank({"mine": singlet()}, pairs, network)


def test_names_of_lenses_are_text_on_a_page():
    pairs = [(torch.rand(3, 32, 32), k) for k in (0, 1)]
    network = Answers(lambda images: images.mean((2, 3)))
    assert "<b>a&b" not in tasklens.rank({"<b>a&b": singlet()}, pairs, network, rays=64)._repr_html_()


def test_a_printed_ranking_is_its_table(tmp_path):
    pairs = [(torch.full((3, 32, 32), 0.3 * k), k) for k in range(3)] * 10
    brightness = Answers(lambda images: -(images.mean((2, 3)) - 0.3 * torch.arange(3.0)).square())
    result = tasklens.rank({"mine": singlet(), "fast": singlet(f_number=2.8)}, pairs, brightness, rays=64)
    for text in (str(result), repr(result)):
        heading, *rows = text.splitlines()
        assert "accuracy [%]" in heading and {row.split()[0] for row in rows} <= {"mine", "fast", "1"}
        assert len(rows) == 2 and "svg" not in text
    assert "<table" in result._repr_html_() and result.sentences
    result.save(tmp_path / "ranking.html", answer=["Mine."])
    assert "Mine." in (tmp_path / "ranking.html").read_text()
