"""Rays and PSFs through a phone lens: this tracer compared with Optiland's and batoid's, same rays, one thread.

    python benchmarks/rays.py [--rounds 15] [--save rays]

A program that is not installed (pip install optiland batoid) is left out. Optiland runs by the fastest calls that we
know: one bundle of rays with a wavelength each, traced by `surfaces.trace`, with parameters updated as its optimizer
does. batoid has double precision and no gradients.
"""

import math
import statistics
import warnings
from collections.abc import Callable
from importlib.util import find_spec

import torch
from ray_floor import floor
from timing import alternate, arguments, ratio, report, spread
from torch import Tensor

from tasklens.materials import material as materials
from tasklens.optics.lens import Lens
from tasklens.optics.psf import psf
from tasklens.optics.rays import Rays, launch
from tasklens.optics.tracing.trace import trace

# The three plastic elements of US 8,558,939 B2, without the filter and cover glass, focused by the last space, behind a
# stop in the plane of the first vertex. Indices at the C, d and F lines from the nd and Vd of its glasses.
WAVELENGTHS = (0.6563, 0.5893, 0.4861)
STOP_RADIUS = 0.45
FRONT = (1.5772589551653218, 1.5801127252733171, 1.5870305392290527)
MIDDLE = (1.7951982371568391, 1.8044180377036882, 1.8267677233750734)
AIR = (1.0, 1.0, 1.0)
SURFACES = (  # curvature, conic, thickness, indices behind, alpha_4 .. alpha_16
    (0.0, 0.0, 0.0, AIR, ()),
    (0.9487666034155597, -0.14294, 0.72, FRONT, (0.038162, 0.06317, -0.020792, 0.18432, -0.04827, 0.094529)),
    (0.49333991119881593, 8.0226, 0.39, AIR, (0.0074974, 0.064686, 0.19354, -0.50703, -0.34529, 5.9938)),
    (*(-0.3209242618741977, -49.984, 0.55, MIDDLE), (-0.31608, 0.34755, -0.17102, -0.41506, -1.342, 5.0594, -2.7483)),
    (
        *(-0.20682523267838676, 1.6674, 0.63, AIR),
        (-0.079727, 0.13899, -0.044057, -0.019369, 0.016993, 0.093716, -0.080329),
    ),
    (
        *(0.2763957987838585, -44.874, 0.7, FRONT),
        (-0.14756, 0.035194, -0.0032262, 0.0018592, 0.00036658, -0.00016039, -3.1846e-05),
    ),
    (
        *(0.46274872744099954, -10.719, 0.93, AIR),
        (-0.096568, 0.026771, -0.011261, 0.0019879, 0.00015579, -0.00012433, 1.5264e-05),
    ),
)
ASPHERES = len(SURFACES) - 1
FIELDS_DEG = [(10.0 * i, 10.0 * j) for i in range(3) for j in range(3)]
_CALLS = 8  # in each turn
NAMES = ("curvature", "conic", "alpha", "thickness")


def read(dtype: torch.dtype) -> tuple[Lens, Tensor]:
    """The lens, and its indices (S + 1, 3)."""
    column = [torch.tensor(values, dtype=dtype) for values in zip(*(s[:3] for s in SURFACES), strict=True)]
    alpha = torch.tensor([(0.0, *s[4], *(0.0,) * (7 - len(s[4]))) for s in SURFACES], dtype=dtype)
    no_limit = torch.full_like(column[0], math.inf)
    lens = Lens(column[0], column[1], alpha, column[2], no_limit, (materials.AIR,) * len(SURFACES), stop=0)
    return lens, torch.tensor([AIR, *(s[3] for s in SURFACES)], dtype=dtype)


def collimated_rays(count: int, dtype: torch.dtype) -> Rays:
    """Rays (9, 3, count) that fill the stop, from z = 0."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    radius, angle = STOP_RADIUS * torch.sqrt(k / count), math.pi * (1 + 5**0.5) * k
    tangent = torch.tan(torch.deg2rad(torch.tensor(FIELDS_DEG, dtype=torch.float64)))
    n = torch.rsqrt(1 + tangent.square().sum(-1)).reshape(-1, 1, 1)
    l, m = (tangent[:, i].reshape(-1, 1, 1) * n for i in (0, 1))
    parts = (radius * torch.cos(angle), radius * torch.sin(angle), torch.zeros_like(radius), l, m, n)
    return launch(*(v.expand(len(FIELDS_DEG), 3, count).contiguous().to(dtype) for v in parts))


def mean_squared_spot(x: Tensor, y: Tensor) -> Tensor:
    x, y = x.reshape(27, -1), y.reshape(27, -1)
    return ((x - x.mean(1, keepdim=True)) ** 2 + (y - y.mean(1, keepdim=True)) ** 2).mean()


def ours(dtype: torch.dtype, train: int, evaluate: int) -> dict[str, Callable[[], object]]:
    """Our loads by name."""
    lens, indices = read(dtype)
    rays, many = collimated_rays(train, dtype), collimated_rays(evaluate, dtype)
    values = {name: getattr(lens, name) for name in NAMES}
    points = torch.tensor(FIELDS_DEG, dtype=torch.float64)
    centre = trace(lens, collimated_rays(1, dtype), indices)
    centre = torch.stack([centre.x[:, 1, 0], centre.y[:, 1, 0]], -1)
    upstream = torch.rand(len(points), 3, 51, 51, dtype=dtype, generator=torch.Generator().manual_seed(0))

    def traced() -> Rays:
        leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
        return trace(Lens(**(vars(lens) | leaves)), rays, indices)

    def spot() -> tuple[Tensor, Tensor]:
        end = traced()
        mean_squared_spot(end.x, end.y).backward()
        return end.x, end.y

    def grid() -> None:
        (psf(traced(), centre, 1.8, 51) * upstream).sum().backward()

    def forward() -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            end = trace(lens, many, indices)
        return end.x, end.y

    return {"trace, forward and backward": spot, "PSFs, forward and backward": grid, "trace, forward": forward}


def optilands(precision: str, train: int, evaluate: int) -> dict[str, Callable[[], object]]:
    """The same loads in Optiland, on its torch backend."""
    import optiland.backend as be
    from optiland.materials import IdealMaterial
    from optiland.materials.base import BaseMaterial
    from optiland.optic import Optic
    from optiland.optimization import OptimizationProblem
    from optiland.rays import RealRays

    be.set_backend("torch")
    be.set_precision(precision)
    be.grad_mode.enable()
    fit = torch.tensor([[w**-4, w**-2, 1.0] for w in WAVELENGTHS], dtype=torch.float64)

    class Glass(BaseMaterial):
        """n = a + b / w^2 + c / w^4 through the three indices: the cheapest dispersion formula."""

        def __init__(self, indices):
            super().__init__()
            self.fit = torch.linalg.solve(fit, torch.tensor(indices, dtype=torch.float64)).tolist()

        def _calculate_n(self, wavelength, **_):
            inverse = 1.0 / (wavelength * wavelength)
            return (self.fit[0] * inverse + self.fit[1]) * inverse + self.fit[2]

        def _calculate_k(self, wavelength, **_):
            return be.zeros_like(be.array(wavelength))

    def optic():
        built = Optic()
        built.surfaces.add(index=0, radius=be.inf, thickness=be.inf)
        for i, (c, k, thickness, indices, alpha) in enumerate(SURFACES, 1):
            material = IdealMaterial(1.0) if indices == AIR else Glass(indices)
            asphere = {"surface_type": "even_asphere", "coefficients": [0.0, *alpha, *(0.0,) * (7 - len(alpha))]}
            built.surfaces.add(
                index=i,
                thickness=thickness,
                is_stop=i == 1,
                conic=k,
                radius=1 / c if c else be.inf,
                material=material,
                **(asphere if alpha else {}),
            )
        built.surfaces.add(index=len(SURFACES) + 1)
        built.set_aperture("EPD", 2 * STOP_RADIUS)
        built.fields.set_type("angle")
        for x, y in FIELDS_DEG:
            built.fields.add(x=x, y=y)
        for i, wavelength in enumerate(WAVELENGTHS):
            built.wavelengths.add(value=wavelength, is_primary=i == 1)
        return built

    def starts(count: int) -> list[Tensor]:
        """Positions, directions and wavelengths: its surfaces stand at z = 0, so rays start before them."""
        rays = collimated_rays(count, torch.float64)
        back = -1 / rays.n
        wavelength = torch.tensor(WAVELENGTHS, dtype=torch.float64)[:, None].expand(rays.x.shape)
        values = (rays.x + back * rays.l, rays.y + back * rays.m, back * rays.n, rays.l, rays.m, rays.n, wavelength)
        with torch.no_grad():
            return [be.array(v.flatten().numpy()).detach() for v in values]

    def traced(through, start: list[Tensor]):
        x, y, z, l, m, n, wavelength = (v.clone() for v in start)
        rays = RealRays(x, y, z, l, m, n, torch.ones_like(x), wavelength)
        through.surfaces.trace(rays, skip=1, record=False)
        return rays

    trained = optic()
    problem = OptimizationProblem()
    for i in range(2, len(SURFACES) + 1):
        for name in ("radius", "conic", "thickness"):
            problem.add_variable(trained, name, surface_number=i)
        for j in range(1, 8):
            problem.add_variable(trained, "asphere_coeff", surface_number=i, coeff_number=j)
    parameters = [torch.nn.Parameter(be.array(v.value)) for v in problem.variables]
    few, still, many = starts(train), optic(), starts(evaluate)

    def spot() -> tuple[Tensor, Tensor]:
        be.set_precision(precision)
        be.grad_mode.enable()
        for parameter, variable in zip(parameters, problem.variables, strict=True):
            parameter.grad = None
            variable.update(parameter)
        problem.update_optics()
        end = traced(trained, few)
        mean_squared_spot(end.x, end.y).backward()
        return end.x, end.y

    def forward() -> tuple[Tensor, Tensor]:
        be.set_precision(precision)
        be.grad_mode.disable()
        with torch.no_grad():
            end = traced(still, many)
        return end.x, end.y

    return {"trace, forward and backward": spot, "trace, forward": forward}


def batoids(precision: str, train: int, evaluate: int) -> dict[str, Callable[[], object]]:
    """The forward load in batoid, a bundle of each wavelength."""
    import batoid

    if precision != "float64":
        return {}
    lenses, z = [], 0.0
    for colour in range(len(WAVELENGTHS)):
        parts, z, before = [], 0.0, 1.0
        for c, k, thickness, indices, alpha in SURFACES[1:]:
            glasses = {"inMedium": batoid.ConstMedium(before), "outMedium": batoid.ConstMedium(indices[colour])}
            surface, place = batoid.Asphere(1 / c, k, list(alpha)), batoid.CoordSys(origin=[0, 0, z])
            parts.append(batoid.RefractiveInterface(surface, name=str(z), coordSys=place, **glasses))
            z, before = z + thickness, indices[colour]
        place = batoid.CoordSys(origin=[0, 0, z])
        lenses.append(batoid.CompoundOptic([*parts, batoid.Detector(batoid.Plane(), name="image", coordSys=place)]))
    rays = collimated_rays(evaluate, torch.float64)
    starts = [
        [getattr(rays, name)[:, colour].flatten().numpy().copy() for name in ("x", "y", "z", "l", "m", "n")]
        for colour in range(len(WAVELENGTHS))
    ]

    def forward() -> tuple[Tensor, Tensor]:
        ends = [lens.trace(batoid.RayVector(*start)) for lens, start in zip(lenses, starts, strict=True)]
        shape = (len(WAVELENGTHS), len(FIELDS_DEG), evaluate)
        return tuple(
            torch.stack([torch.from_numpy(v.copy()) for v in values]).reshape(shape).transpose(0, 1).flatten()
            for values in ([end.x for end in ends], [end.y for end in ends])
        )

    return {"trace, forward": forward}


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args(argv)
    train, evaluate = (16, 32) if options.tiny else (256, 4096)
    torch.ones(7_000_000)  # as after any step of a design: the allocator has learned to keep freed memory
    warnings.filterwarnings("ignore")
    peers = {"Optiland": optilands, "batoid": batoids}
    peers = {name: loads for name, loads in peers.items() if find_spec(name.lower())}
    rows = []
    for precision in ("float32", "float64"):
        work = ours(getattr(torch, precision), train, evaluate)
        others = {name: loads(precision, train, evaluate) for name, loads in peers.items()}
        for loads in others.values():  # the same image
            for load, function in loads.items():
                for mine, theirs in zip(work[load](), function(), strict=True):
                    torch.testing.assert_close(mine.flatten(), theirs, rtol=0, atol=1e-5)
        for name, function in work.items():
            versus = {peer: loads[name] for peer, loads in others.items() if name in loads}
            if name.startswith("PSFs"):
                versus = {"trace alone": work["trace, forward and backward"]}
            times = alternate({"ours": function} | versus, options.rounds, _CALLS)
            backward = name != "trace, forward"
            rays = 27 * (train if backward else evaluate)
            least = floor(getattr(torch, precision), rays, ASPHERES)[backward]
            speeds = (rays * ASPHERES / seconds for seconds in (statistics.median(times["ours"]), least))
            ours_cells = f"{1e3 * least:.2g}", *(f"{speed:.2g}" for speed in speeds)
            for peer in versus or ["–"]:
                cells = (spread(times[peer], 1e3), ratio(times[peer], times["ours"])) if versus else ("–", "–")
                rows.append((name, precision, spread(times["ours"], 1e3), peer, *cells, *ours_cells))
    columns = ("load", "precision", "ours [ms]", "against", "its time [ms]", "ratio", "floor of the rays [ms]")
    columns += ("rays x aspheres per second", "at the floor")
    report("Rays and PSFs, 9 fields x 3 colours", columns, rows, options.save)


if __name__ == "__main__":
    main()
