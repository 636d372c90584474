"""Variables of a lens in a design."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from tasklens.materials.material import AIR
from tasklens.optics.analysis.aiming import stop_is_inside
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.spots import clear_semi_diameters
from tasklens.optics.io.stop import stop_radius
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.settings.design_settings import LearningRates

Free = Mapping[Any, Sequence[int]]  # free variables by name, and the surfaces on which they are free
ORDERS = (4, 6, 8, 10)  # orders of asphere coefficients in designs; alpha_2 would duplicate the curvature


@dataclass(frozen=True)
class Variables:
    """Variables of a design: curvatures and asphere coefficients of refracting surfaces, and the spaces behind them.

    Attributes:
        lens: lens with the other values.
        radius: (S,) normalisation radius R of each surface [mm]. A variable is alpha_2j R^(2j - 1), the slope at R up
            to a factor, so that one step size suits small and large surfaces.
        f_number: F-number that a stop inside the lens keeps, and its wavelength [um]; None: the stop keeps its radius.
    """

    lens: Lens
    radius: Tensor
    f_number: tuple[float, float] | None = None

    @classmethod
    def plain(cls, lens: Lens, view: View | None = None) -> "Variables":
        """Return variables without normalisation, R = 1 mm; with a view, a stop inside the lens keeps its F-number."""
        return cls(lens, torch.ones_like(lens.curvature), None if view is None else _f_number(lens, view))

    @classmethod
    def normalised(cls, lens: Lens, view: View) -> "Variables":
        """Return variables with R = the illuminated radius on each surface of `lens`, at least that of the stop."""
        radius = clear_semi_diameters(lens.detached(), view).clamp(min=float(lens.semi_diameter[lens.stop]))
        return cls(lens, radius, _f_number(lens, view))

    def _scale(self, order: int) -> Tensor:
        return self.radius[list(self.lens.refracting_surfaces)] ** (order - 1)

    def values(self) -> dict[str, Tensor]:
        """Return values by name, `curvature`, `thickness`, `alpha_4` .., each (G,) for G refracting surfaces."""
        refracting = list(self.lens.refracting_surfaces)
        values = {"curvature": self.lens.curvature[refracting], "thickness": self.lens.thickness[refracting]}
        values |= {
            f"alpha_{order}": self.lens.alpha[refracting, order // 2 - 1] * self._scale(order) for order in ORDERS
        }
        return {name: value.detach().clone() for name, value in values.items()}

    def free(self, free: Free | None) -> Tensor:
        """Return a mask (V,) of the free variables among all of `values`, concatenated."""
        refracting = self.lens.refracting_surfaces
        if free is None:
            return torch.ones(len(refracting) * (2 + len(ORDERS)), dtype=torch.bool)
        for name, surfaces in free.items():
            for surface in surfaces:
                if surface not in refracting:
                    numbers = ", ".join(map(str, refracting))
                    raise InputError(f"free: {name}: surface {surface} does not refract; expected some of {numbers}")
        return torch.tensor([surface in free.get(name, ()) for name in self.values() for surface in refracting])

    def directions(self, names: Iterable[str]) -> dict[str, Tensor]:
        """Return V unit changes of the variables `names`: `curvature`, `thickness` (V, S) and `alpha` (V, S, M)."""
        refracting, names = list(self.lens.refracting_surfaces), list(names)
        changes = {
            name: torch.zeros(len(names), len(refracting), *getattr(self.lens, name).shape, dtype=self.lens.dtype)
            for name in ("curvature", "thickness", "alpha")
        }
        for k, name in enumerate(names):
            for i, surface in enumerate(refracting):
                if name in changes:
                    changes[name][k, i, surface] = 1
                else:
                    order = int(name.removeprefix("alpha_"))
                    changes["alpha"][k, i, surface, order // 2 - 1] = 1 / self._scale(order)[i]
        return {name: change.flatten(0, 1) for name, change in changes.items()}

    def assemble_vector(self, names: Sequence[str], vector: Tensor) -> Lens:
        """Return the lens with the concatenated values (V,) of `names`, as `assemble` does."""
        return self.assemble(dict(zip(names, vector.reshape(len(names), -1), strict=True)))

    def assemble(self, values: Mapping[str, Tensor]) -> Lens:
        """Return the lens with these values, differentiable in them; other variables are unchanged."""
        refracting = torch.tensor(self.lens.refracting_surfaces)

        def put(name: str, old: Tensor, scale: Tensor | float = 1.0) -> Tensor:
            return old.index_copy(0, refracting, values[name] / scale) if name in values else old

        columns = [
            put(f"alpha_{2 * j}", column, self._scale(2 * j)) for j, column in enumerate(self.lens.alpha.unbind(-1), 1)
        ]
        lens = replace(
            self.lens,
            curvature=put("curvature", self.lens.curvature),
            thickness=put("thickness", self.lens.thickness),
            alpha=torch.stack(columns, -1),
        )
        if self.f_number is None:
            return lens
        value, wavelength = self.f_number
        return lens.with_stop_radius(stop_radius(lens.detached(), ("f_number", value), wavelength))


def free_surfaces(lens: Lens, free: Mapping[str, Sequence[int] | None] | None) -> dict[str, tuple[int, ...]]:
    """Return free variables with their surfaces.

    Args:
        lens: the lens.
        free: surfaces by variable. None for the surfaces of a variable selects all that bend light; for thicknesses,
            all but those of plane plates. None for `free` selects curvatures, distances, and the coefficients of
            aspheres.

    Raises:
        InputError: a variable is unknown, or none is free.
    """
    refracting = lens.refracting_surfaces
    curved_surfaces = tuple(i for i in refracting if lens.curvature[i] or lens.alpha[i].any())
    thickness_surfaces = tuple(
        i for i in refracting if i in curved_surfaces or i + 1 in curved_surfaces or lens.media[i] == AIR
    )
    defaults = {
        "curvature": curved_surfaces,
        "thickness": thickness_surfaces,
        **{f"alpha_{order}": curved_surfaces for order in ORDERS},
    }
    if free is None:
        aspheres = tuple(i for i in curved_surfaces if lens.alpha[i].any() or lens.conic[i])
        return defaults | {f"alpha_{order}": aspheres for order in ORDERS}
    if not isinstance(free, Mapping) or any(isinstance(surfaces, int | str) for surfaces in free.values()):
        raise InputError(f"free: expected surfaces by variable, such as {{'curvature': [1, 2]}}, got {free!r}")
    if unknown_names := [name for name in free if name not in defaults]:
        raise InputError(f"free: unknown variable {unknown_names[0]!r}; expected some of {', '.join(defaults)}")
    variables = {name: defaults[name] if surfaces is None else tuple(surfaces) for name, surfaces in free.items()}
    if not any(variables.values()):
        raise InputError("free: expected at least one variable of one surface")
    return variables


def with_coefficients(lens: Lens) -> Lens:
    """Return a lens with all coefficients of a design; those that it lacks are zero."""
    missing = max(0, ORDERS[-1] // 2 - lens.alpha.shape[1])
    return replace(lens, alpha=torch.nn.functional.pad(lens.alpha, (0, missing)))


def _f_number(lens: Lens, view: View) -> tuple[float, float] | None:
    """Return the F-number of a lens and its wavelength, if its stop is inside; one in front keeps its radius."""
    if not stop_is_inside(lens):
        return None
    first_order = paraxial(lens.detached(), view.reference_um)
    return float(first_order.f_number), view.reference_um


def parameter_groups(values: Mapping[str, Tensor], rates: LearningRates) -> list[dict[str, Any]]:
    """Return AdamW's groups, one per kind of variable; learning rates of asphere orders decrease by `rates.decay`."""
    rate = {"curvature": rates.curvature, "thickness": rates.thickness}
    rate |= {f"alpha_{order}": rates.alpha_4 * rates.decay**k for k, order in enumerate(ORDERS)}
    return [{"params": [value], "lr": rate[name], "weight_decay": 0.0} for name, value in values.items()]
