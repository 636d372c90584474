"""Lens files: lossless, and plain about what is wrong with them."""

import copy
import math

import pytest
import torch
import yaml
from examples import make_lens, random_lens

from tasklens.optics import prescription

TENSORS = ("curvature", "conic", "alpha", "thickness", "semi_diameter")


@pytest.mark.parametrize("seed", range(5))
def test_round_trip_keeps_every_bit(tmp_path, seed):
    """Awkward numbers included: 1 / 3, denormals, negative zero, infinite apertures."""
    lens = random_lens(seed)
    lens.semi_diameter[1:] = lens.semi_diameter.new_tensor([1 / 3, math.pi, 1e-17, math.inf])
    lens.alpha[1] = lens.alpha.new_tensor([5e-324, -0.0, 1e22, 1e-7, 0.1 + 0.2])
    path = tmp_path / "lens.yaml"
    prescription.write(path, lens, {"origin": {"seed": seed}})
    found, content = prescription.read(path)
    for name in TENSORS:
        a, b = getattr(lens, name), getattr(found, name)
        assert torch.equal(a.view(torch.int64), b.view(torch.int64)), name
    assert (found.media, found.stop) == (lens.media, lens.stop)
    assert content["origin"] == {"seed": seed}
    assert yaml.safe_load(path.read_text()) == content


def test_lens_without_aspheres(tmp_path):
    lens = make_lens([0.5, -0.5], [1.0, 2.0], ("COC", "air"), semi_diameter=[0.5, 1.0], stop=1)
    prescription.write(tmp_path / "lens.yaml", lens, {})
    found, _ = prescription.read(tmp_path / "lens.yaml")
    assert found.alpha.shape == (2, 0) and found.stop == 1


def broken(change) -> dict:
    content = copy.deepcopy(prescription.to_dict(random_lens(0)))
    change(content)
    return content


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda c: c.update(format=2), ["format", "2", "1"]),
        (lambda c: c.pop("format"), ["format", "None"]),
        (lambda c: c["surfaces"][2].pop("conic"), ["surface 2", "conic"]),
        (lambda c: c["surfaces"][1].update(radius=3.0), ["surface 1", "radius"]),
        (lambda c: c["surfaces"][1].update(alpha_5=3.0), ["surface 1", "alpha_5"]),
        (lambda c: c["surfaces"][1].update(alpha_0=3.0), ["surface 1", "alpha_0"]),
        (lambda c: c.update(stop=5), ["stop", "5"]),
    ],
)
def test_a_wrong_file_is_refused_with_the_reason(change, words):
    with pytest.raises(ValueError) as error:
        prescription.from_dict(broken(change))
    assert all(word in str(error.value) for word in words)


def test_missing_orders_are_zero():
    """A file may leave out alpha_2j of single surfaces."""
    content = broken(lambda c: [c["surfaces"][1].pop(f"alpha_{k}") for k in (4, 10)])
    alpha = prescription.from_dict(content).alpha
    assert alpha.shape == (5, 5)
    assert alpha[1, 1] == alpha[1, 4] == 0 and (alpha[2] != 0).all()


def test_a_lens_with_inconsistent_shapes_is_refused():
    with pytest.raises(ValueError, match="thickness"):
        make_lens([0.0, 0.0], [1.0], ("COC", "air"))
