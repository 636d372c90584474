"""Random prescriptions, and lenses compared to the last bit."""

import math

import torch
from examples import make_lens, materials

from tasklens.materials.material import AIR, Material, model_glass
from tasklens.optics.io.prescription import APERTURES, FIELDS, Prescription
from tasklens.optics.lens import Lens

TENSORS = ("curvature", "conic", "alpha", "thickness", "semi_diameter")


def tensors(lens: Lens) -> tuple[torch.Tensor, ...]:
    """All numbers of a lens."""
    return tuple(getattr(lens, name) for name in TENSORS)


def same_bits(a: Lens, b: Lens) -> bool:
    """Return whether two lenses have the same numbers to the last bit, negative zeros included, and the same media."""
    pairs = zip(tensors(a), tensors(b), strict=True)
    same_numbers = all(torch.equal(x.view(torch.int64), y.view(torch.int64)) for x, y in pairs)
    return same_numbers and (a.media, a.stop) == (b.media, b.stop)


def random_prescription(seed: int) -> Prescription:
    """Any number of surfaces and orders, numbers of every size, every kind of medium, aperture and field."""
    generator = torch.Generator().manual_seed(seed)

    def pick(count: int) -> int:
        return int(torch.randint(count, (), generator=generator))

    def awkward(*shape: int) -> torch.Tensor:
        """Random signs, fractions and powers of ten from 1e-20 to 1e20."""
        sign = 1 - 2 * torch.randint(2, shape, generator=generator).double()
        power = torch.randint(-20, 21, shape, generator=generator).double()
        return sign * torch.rand(shape, generator=generator, dtype=torch.float64) * 10.0**power

    surfaces, orders = 1 + pick(9), pick(15)
    odd = Material("Größe: 3", "conrady", tuple(awkward(3).tolist()), (0.4, 0.7), "mine: # 1")
    kinds = (AIR, *materials("COC", "OKP4"), odd, model_glass(1.544, 55.9, 0.01, "APL"), model_glass(1.6, 0.0, 0.0))
    semi_diameter = awkward(surfaces).abs()
    semi_diameter[pick(surfaces)] = math.inf
    lens = make_lens(
        awkward(surfaces),
        awkward(surfaces).abs(),
        [*(kinds[pick(len(kinds))] for _ in range(surfaces - 1)), AIR],
        conic=awkward(surfaces),
        alpha=awkward(surfaces, orders),
        semi_diameter=semi_diameter,
        stop=pick(surfaces),
    )
    return Prescription(
        lens=lens,
        title=("", "2012", "yes: 'a' # title", "Ø 30 mm")[pick(4)],
        comments=(*(("", "front", "1e-3", "null")[pick(4)] for _ in range(surfaces - 1)), "last"),
        aperture=(APERTURES[pick(2)], float(awkward(1).abs())),
        fields=(FIELDS[pick(4)], tuple(map(tuple, awkward(1 + pick(5), 2).tolist()))),
        wavelengths_um=tuple(awkward(3).abs().tolist()),
        primary=pick(3),
        object_distance_mm=(math.inf, float(awkward(1).abs()))[pick(2)],
    )
