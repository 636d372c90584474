"""Which numbers of a lens a design may change."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from tasklens.optics.analysis.spots import clear_semi_diameters
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.study.design_settings import LearningRates

ORDERS = (4, 6, 8, 10)  # of the asphere coefficients that designs use; an r^2 term would duplicate the curvature


@dataclass(frozen=True)
class Variables:
    """The numbers of `lens` that a design may change: those of refracting surfaces and the spaces behind them.

    Attributes:
        radius: (S,) R of each surface [mm]. A design sees alpha_2j R^(2j - 1), up to a factor the slope at R, so that
            one step size suits small and large surfaces; files see alpha_2j.
    """

    lens: Lens
    radius: Tensor

    @classmethod
    def plain(cls, lens: Lens) -> "Variables":
        """The coefficients as they are: R = 1 mm."""
        return cls(lens, torch.ones_like(lens.curvature))

    @classmethod
    def stepped(cls, lens: Lens, view: View, rates: LearningRates) -> "Variables":
        """As `rates` are meant: R = the radius that light uses on each surface of `lens` if they are normalised."""
        return cls.normalised(lens, view) if rates.normalised else cls.plain(lens)

    @classmethod
    def normalised(cls, lens: Lens, view: View) -> "Variables":
        """R = the radius that light uses on each surface of `lens`."""
        return cls(lens, clear_semi_diameters(lens.detached(), view).clamp(min=float(lens.semi_diameter[lens.stop])))

    def _scale(self, order: int) -> Tensor:
        return self.radius[list(self.lens.refracting_surfaces)] ** (order - 1)

    def values(self) -> dict[str, Tensor]:
        """Present values by name, `curvature`, `thickness`, `alpha_4` .., each (G,) for G refracting surfaces."""
        refracting = list(self.lens.refracting_surfaces)
        values = {"curvature": self.lens.curvature[refracting], "thickness": self.lens.thickness[refracting]}
        values |= {
            f"alpha_{order}": self.lens.alpha[refracting, order // 2 - 1] * self._scale(order) for order in ORDERS
        }
        return {name: value.detach().clone() for name, value in values.items()}

    def directions(self, names: Iterable[str]) -> dict[str, Tensor]:
        """V unit changes of the variables `names` in the order of `values`: `curvature` (V, S), `alpha` (V, S, M)."""
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
        """As `assemble`, from the values of `names` one after the other."""
        return self.assemble(dict(zip(names, vector.reshape(len(names), -1), strict=True)))

    def assemble(self, values: Mapping[str, Tensor]) -> Lens:
        """The lens with these values in it, differentiable in them; what is not named keeps its value."""
        refracting = torch.tensor(self.lens.refracting_surfaces)

        def put(name: str, old: Tensor, scale: Tensor | float = 1.0) -> Tensor:
            return old.index_copy(0, refracting, values[name] / scale) if name in values else old

        columns = [
            put(f"alpha_{2 * j}", column, self._scale(2 * j)) for j, column in enumerate(self.lens.alpha.unbind(-1), 1)
        ]
        return replace(
            self.lens,
            curvature=put("curvature", self.lens.curvature),
            thickness=put("thickness", self.lens.thickness),
            alpha=torch.stack(columns, -1),
        )


def parameter_groups(values: Mapping[str, Tensor], rates: LearningRates) -> list[dict[str, Any]]:
    """AdamW's groups: one per kind of variable, each asphere order at `rates.decay` times the one before."""
    rate = {"curvature": rates.curvature, "thickness": rates.thickness}
    rate |= {f"alpha_{order}": rates.alpha_4 * rates.decay**k for k, order in enumerate(ORDERS)}
    return [{"params": [value], "lr": rate[name], "weight_decay": 0.0} for name, value in values.items()]
