"""A lens and a sensor in front of a network, in the training loop of a user."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from tasklens.design import from_lens
from tasklens.design.constraints import penalty
from tasklens.design.variables import Variables, with_coefficients
from tasklens.imaging import PsfCamera, noise
from tasklens.notebook.captures import check_choices, check_light
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.lens import Lens
from tasklens.optics.view import View
from tasklens.runtime.errors import InputError
from tasklens.study.settings import Constraints

if TYPE_CHECKING:
    from tasklens.study.settings import SensorSettings


class Camera(nn.Module):
    """A camera for any network: captures of images through a lens, differentiable in the lens.

    Its parameters are what is free of the lens, without units, so that one learning rate suits all of them, and lenses
    of any size: curvatures times the radius R that light uses on the surface, distances over the focal length, and
    coefficients alpha_k R^(k - 1). A step of Adam of 1e-3 moves a surface of a phone lens by about a micrometre. Of a
    stop inside the lens, gradients leave out how the aim of the rays through it moves.

    Args:
        lens: the lens at the beginning.
        view: its fields, wavelengths and pixels.
        free: variables, and the surfaces on which they are free: {"curvature": [0, 1], "thickness": None}, None: on all
            of them; also alpha_4 .. alpha_10. By default curvatures, distances, and the coefficients of aspheres; none
            by {}.
        rays: number of rays of each field and colour.
        colour, outside_window, sensor: as in `tasklens.simulate`.

    Raises:
        InputError: an unknown variable or value, or a lens without light at some field.

    Example:
        >>> camera = tasklens.Camera(lens, view)
        >>> optimizer = torch.optim.Adam([*camera.parameters(), *network.parameters()], lr=1e-3)
        >>> loss = cross_entropy(network(camera(images)), labels) + 100 * camera.penalty()
    """

    def __init__(
        self,
        lens: Lens,
        view: View,
        free: Mapping[str, Sequence[int] | None] | None = None,
        *,
        rays: int = 1024,
        colour: str = "srgb",
        outside_window: str = "veil",
        sensor: "SensorSettings | None" = None,
    ):
        super().__init__()
        check_choices(colour, outside_window)
        check_light(lens, view)
        self.view, self.rays = view.in_colours(), rays
        self.colour, self.outside_window, self.sensor = colour, outside_window, sensor
        start = with_coefficients(lens.detached())
        self._variables = Variables.normalised(start, self.view)
        chosen = {} if free is not None and not free else from_lens.resolved(start, free)
        refracting = list(start.refracting_surfaces)
        radius = self._variables.radius[refracting]
        scales = {"curvature": radius, "thickness": torch.full_like(radius, 1 / view.efl)}
        self.limits, _ = from_lens.own_limits(start, self.view, Constraints(), set())
        self._scales, self._free = {}, {}
        self.variables = nn.ParameterDict()
        for name, values in self._variables.values().items():
            if surfaces := chosen.get(name):
                self._scales[name] = scales.get(name, torch.ones_like(values))
                self._free[name] = torch.tensor([surface in surfaces for surface in refracting])
                self.variables[name] = nn.Parameter(values * self._scales[name])

    @property
    def lens(self) -> Lens:
        """The present lens, differentiable in the parameters."""
        held, values = self._variables.values(), {}
        for name, parameter in self.variables.items():
            value = parameter.to("cpu", torch.float64) / self._scales[name]
            values[name] = torch.where(self._free[name], value, held[name])
        return self._variables.assemble(values)

    def forward(self, images: Tensor, fields: Tensor | None = None) -> Tensor:
        """Capture images (B, 3, H, W) in [0, 1], each at one field of the sensor: (B, 3, H, W).

        Args:
            fields: (B,) index of the field of each image; None: at random, by torch's generator.
        """
        if fields is None:
            fields = torch.randint(len(self.view.fields), (len(images),))
        drawn = None if self.sensor is None else noise(images.shape, torch.default_generator)
        return self._camera(images).single(images, fields, drawn)

    def all_fields(self, images: Tensor) -> Tensor:
        """Capture images (B, 3, H, W) in [0, 1] at all F fields: (F, B, 3, H, W)."""
        return self._camera(images).grid(images, torch.default_generator)

    def penalty(self) -> Tensor:
        """Compute how far the lens violates its limits, to be added to a loss: zero for the lens at the beginning.

        Focal length, distortion, and distances and slopes that can be made, as in `tasklens design --start`.
        """
        return penalty(self.lens, self.limits, self.view)

    def _camera(self, images: Tensor) -> PsfCamera:
        if images.dim() != 4 or images.shape[1] != 3 or not images.is_floating_point():
            raise InputError(f"images: expected (B, 3, H, W) in [0, 1], got {tuple(images.shape)} of {images.dtype}")
        lens = self.lens
        light = None if self.sensor is None else relative_illumination(lens.detached(), self.view)
        psf = evaluation_psf(lens, self.view, self.rays).float().to(images.device)
        return PsfCamera(psf, self.outside_window, self.colour, self.sensor, light)
