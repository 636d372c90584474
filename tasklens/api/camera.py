"""A lens and a sensor in front of a network, for a user's own training loop."""

import warnings
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor, nn

from tasklens.api.captures import check_light
from tasklens.camera.imaging import PsfCamera, check_capture, check_images, field_indices
from tasklens.design.constraints import penalty
from tasklens.design.from_lens import own_limits
from tasklens.design.variables import Variables, free_surfaces, with_coefficients
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.analysis.pupil import check_rays
from tasklens.optics.analysis.spots import evaluation_psf
from tasklens.optics.lens import Lens
from tasklens.optics.psf import energy_inside, window_remark
from tasklens.optics.view import View, drawn_points
from tasklens.runtime.errors import InputError
from tasklens.runtime.tensors import explain_errors
from tasklens.settings.capture_settings import SensorSettings
from tasklens.settings.specification import Constraints

_FORMAT = 2.0  # of the state: parameters are changes
_SAME = 1e-6  # relative difference of numbers of the same lens, computed on two machines
_ROUNDING = 1e-3  # tolerance of images in [0, 1], for augmented ones


class Camera(nn.Module):
    """A camera for any network: captures of images through a lens, differentiable in the lens.

    Its parameters are changes of the free lens variables in dimensionless form, so that one learning rate suits all
    variables and lenses of any size: curvatures times the illuminated radius R of the surface, distances divided by the
    focal length, and coefficients alpha_k R^(k - 1). An Adam step of 1e-3 moves a surface of a phone lens by about a
    micrometre; weight decay draws the lens back to the initial one. If the stop is inside the lens, gradients neglect
    the change of its radius, which keeps the F-number. A warning says once if less than half of the light of a field
    is inside the PSF window.

    Args:
        lens: the initial lens.
        view: fields, wavelengths and pixels of the lens.
        free: free variables with their surfaces: {"curvature": [0, 1], "thickness": None}, where None means all
            surfaces; also alpha_4 .. alpha_10. By default, curvatures, distances and the coefficients of aspheres are
            free; {} frees nothing.
        rays: number of rays for each field and colour.
        colour, outside_window, sensor: as in `tasklens.simulate`.

    Raises:
        InputError: a variable or value is unknown, a surface does not refract, or no light arrives at some field.

    Example:
        >>> camera = tasklens.Camera(lens, view)
        >>> optimizer = torch.optim.Adam([*camera.parameters(), *network.parameters()], lr=1e-3)
        >>> loss = cross_entropy(network(camera(images)), labels) + 100 * camera.penalty()
    """

    @explain_errors
    def __init__(
        self,
        lens: Lens,
        view: View,
        free: Mapping[str, Sequence[int] | None] | None = None,
        *,
        rays: int = 1024,
        colour: str | None = None,
        outside_window: str = "veil",
        sensor: SensorSettings | None = None,
    ):
        super().__init__()
        check_capture(colour, outside_window, sensor)
        if lens.dtype != torch.float64:
            raise InputError(f"lens: expected double precision, as of `load_lens`, got {lens.dtype}")
        check_light(lens, view)
        check_rays(rays)
        self.view, self.rays = view.in_colours(), rays
        self.colour, self.outside_window, self.sensor = colour, outside_window, sensor
        start = with_coefficients(lens.detached())
        self._variables = Variables.normalised(start, self.view)
        surfaces_of = {} if free is not None and not free else free_surfaces(start, free)
        self._variables.free(surfaces_of)  # checks the surfaces
        refracting = list(start.refracting_surfaces)
        radius = self._variables.radius[refracting]
        scales = {"curvature": radius, "thickness": torch.full_like(radius, 1 / view.efl)}
        self.limits, _ = own_limits(start, self.view, Constraints(), set())
        self._scales, self._free = {}, {}
        self.variables = nn.ParameterDict()
        for name, values in self._variables.values().items():
            if surfaces := surfaces_of.get(name):
                self._scales[name] = scales.get(name, torch.ones_like(values))
                self._free[name] = torch.tensor([surface in surfaces for surface in refracting])
                self.variables[name] = nn.Parameter(torch.zeros_like(values))
        numbers = [*self._variables.values().values(), *self._scales.values(), *self._free.values()]
        numbers = [*numbers, torch.tensor([_FORMAT])]  # a state of parameters with another meaning does not fit
        self._remarked = False
        self._remark(evaluation_psf(start, self.view, rays))
        self._start = torch.cat([values.detach().double().flatten() for values in numbers])

    @property
    def lens(self) -> Lens:
        """The current lens, differentiable in the parameters."""
        initial, values = self._variables.values(), {}
        for name, parameter in self.variables.items():
            change = parameter.to("cpu", torch.float64) / self._scales[name]
            values[name] = initial[name] + torch.where(self._free[name], change, 0.0)
        return self._variables.assemble(values)

    def get_extra_state(self) -> Tensor:
        """Return the numbers of the initial lens, by which its parameters are scaled."""
        return self._start.clone()

    def set_extra_state(self, state: Tensor) -> None:
        """Check that a state belongs to the initial lens of this camera; raises InputError."""
        is_same = state.shape == self._start.shape
        if not is_same or not torch.allclose(state.to(self._start), self._start, rtol=_SAME, atol=_SAME):
            raise InputError(
                "load_state_dict: the state is that of a camera with another initial lens, view or free variables; "
                "build the camera as it was built then"
            )

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Camera":
        """Move the parameters, but keep their double precision: `half()` would round the lens."""

        def moved(tensor: Tensor) -> Tensor:
            result = fn(tensor)
            return result if result.dtype == tensor.dtype else tensor.to(result.device)

        return super()._apply(moved, recurse)

    @torch.compiler.disable
    @explain_errors
    def forward(self, images: Tensor, fields: Sequence[int] | Tensor | None = None) -> Tensor:
        """Capture images (B, 3, H, W) in [0, 1], each at one field of the sensor: (B, 3, H, W), of the same type.

        Args:
            fields: (B,) index of the field of the view for each image; None: fields over the whole sensor, drawn
                uniformly in area from torch's default generator, so that training sees no fixed points alone.

        Raises:
            InputError: images or fields of another shape, or a lens that is not finite.
        """
        view = self.view
        if fields is None:
            view = view.at(drawn_points(1, seed=int(torch.randint(2**31, ()))))
        indices = field_indices(fields, len(images), len(view.fields))  # refused before the lens is traced
        return self._camera(images, view)(images, indices).to(images.dtype)

    @torch.compiler.disable
    @explain_errors
    def all_fields(self, images: Tensor) -> Tensor:
        """Capture images (B, 3, H, W) in [0, 1] at all F fields: (F, B, 3, H, W)."""
        return self._camera(images, self.view).all_fields(images).to(images.dtype)

    @torch.compiler.disable
    @explain_errors
    def penalty(self) -> Tensor:
        """Compute the violation of the lens's limits, as a penalty on a loss: zero for the initial lens.

        The limits are focal length, distortion, and manufacturable distances and slopes, as in
        `tasklens design --start`.
        """
        return penalty(self.lens, self.limits, self.view)

    def _remark(self, psf: Tensor) -> None:
        """Warn the first time that less than half of the light of a field is inside the PSF window."""
        if not self._remarked and (remark := window_remark(energy_inside(psf), self.view.kernel_size)):
            self._remarked = True
            warnings.warn(remark, stacklevel=4)

    def _camera(self, images: Tensor, view: View) -> PsfCamera:
        check_images(images)
        low, high = (float(bound) for bound in images.detach().aminmax())
        if not (low >= -_ROUNDING and high <= 1 + _ROUNDING):
            raise InputError(f"images: expected values in [0, 1], got {low:g} to {high:g}")
        lens = self.lens
        if bad := lens.not_finite:
            raise InputError(f"{bad} of the lens is not finite: the training diverged; lower the learning rate")
        light = None if self.sensor is None else relative_illumination(lens.detached(), view)
        psf = evaluation_psf(lens, view, self.rays)
        self._remark(psf)
        psf = psf.float().to(images.device)
        return PsfCamera(
            psf, colour=self.colour, outside_window=self.outside_window, sensor=self.sensor, illumination=light
        )
