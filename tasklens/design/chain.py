"""Designs one after another: a lens, the lenses that it starts from, and its baselines."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from tasklens.design import methods
from tasklens.design.supervision import Supervision, supervision
from tasklens.optics.io.prescription import Prescription, with_system_data
from tasklens.optics.lens import Lens
from tasklens.optics.psf import window_remark
from tasklens.optics.view import View, view_of_spec
from tasklens.runtime.errors import InputError
from tasklens.settings.image_settings import ImageSettings
from tasklens.settings.lens_entries import LensDesign


@dataclass(frozen=True)
class Designs:
    """A lens, its starting lenses and its baselines, by name of their designs; the lens is the last one.

    Attributes:
        notes: notes for its file.
        supervision: images and network of the design.
        prescription: the lens with the data of its file; those of `start` stay.
        trained: the network, if it was trained with the lens.
    """

    lenses: Mapping[str, Lens]
    view: View
    notes: dict[str, Any]
    supervision: Supervision
    prescription: Prescription
    trained: nn.Module | None

    @property
    def trained_weights(self) -> dict[str, Tensor] | None:
        """Weights of the trained network, without our normalisation of its input."""
        from tasklens.recognition.classifiers import Classifier

        if self.trained is None:
            return None
        network = self.trained.network if isinstance(self.trained, Classifier) else self.trained
        return network.state_dict()

    @property
    def remark(self) -> str:
        """Remark on the light outside the PSF window of the lens; empty if it is less than half."""
        return window_remark(torch.tensor(self.notes["figures"]["energy_in_window"]), self.view.kernel_size)

    @property
    def lens(self) -> Lens:
        """The requested lens."""
        return list(self.lenses.values())[-1]


def design(
    plans: Mapping[str, LensDesign], images: ImageSettings, user: Supervision, given: Mapping[str, Lens]
) -> Designs:
    """Design lenses in order; each may start from those before it, and from `given` lenses.

    Args:
        plans: settings of the designs, by the names of their lenses.
        images: settings of their images.
        user: images, network and task of a user.

    Raises:
        InputError: a design starts from the most accurate of several lenses, whose accuracies nobody has measured; or
            `supervision` raises it.
    """
    for plan in plans.values():
        if plan.entry.by_accuracy and len(plan.starts) > 1:
            raise InputError(
                f"{plan.entry.design_name} starts from one lens, got {', '.join(plan.starts)}; choose one with `start` "
                f"(on the command line --set start=[{plans[plan.starts[0]].entry.design_name}])"
            )
    lenses, names = {**given}, {name: name for name in given}
    with tempfile.TemporaryDirectory() as folder:
        shared = supervision(list(plans.values()), images, Path(folder), user)
        for name, plan in plans.items():
            names[name] = plan.entry.design_name
            lenses[name], notes, _, trained = methods.design(
                plan,
                shared.network if plan.entry.by_network else None,
                shared.images if plan.entry.reads_images else None,
                {other: lenses[other] for other in plan.starts},
                dict.fromkeys(plan.starts, 0.0) if plan.entry.by_accuracy else {},
                task=shared.task if plan.entry.by_network else None,
            )
    view = view_of_spec(plan.spec)
    prescription = with_system_data(Prescription(lenses[name]), view)
    by_design = {names[name]: lens for name, lens in lenses.items()}
    return Designs(by_design, view, notes, shared, prescription, trained)
