"""`Camera`, a lens in front of the user's own network: captures, gradients, limits, training."""

from dataclasses import replace

import pytest
import torch
from examples import difference
from torch import nn

import tasklens
from tasklens.optics.analysis.illumination import relative_illumination
from tasklens.optics.view import drawn_points
from tasklens.runtime.errors import InputError
from tasklens.settings.capture_settings import SensorSettings

SMALL = [  # the stop is in front, so ray aiming does not depend on the lens
    {"radius": float("inf"), "thickness": 0.1, "stop": True},
    {"radius": 1.6, "thickness": 0.7, "material": "COC"},
    {"radius": -4.0},
]


@pytest.fixture(scope="module")
def lens():
    return tasklens.lens(SMALL, field_of_view_deg=30, f_number=4, pixel_pitch_um=4.0, kernel_size=15)


@pytest.fixture
def images():
    return torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(0))


def test_captures_are_those_of_simulate(lens, images):
    """Captures of one field per image, and of all fields."""
    camera = tasklens.Camera(*lens, rays=4096)
    grid = camera.all_fields(images)
    assert grid.shape == (9, 4, 3, 32, 32)
    torch.testing.assert_close(grid[:, 1], tasklens.simulate(*lens, images[1]), rtol=0, atol=1e-6)
    single = camera(images, torch.tensor([8, 0, 3, 8]))
    for k, field in enumerate((8, 0, 3, 8)):
        torch.testing.assert_close(single[k], grid[field, k], rtol=0, atol=1e-5)


def test_gradients_at_the_parameters_are_differences(lens, images):
    """Gradient of the captures' contrast at each curvature; with many rays, their jumps between pixels average out."""
    camera = tasklens.Camera(*lens, {"curvature": None}, rays=4096)
    ((name, parameter),) = camera.named_parameters()
    assert name == "variables.curvature" and parameter.shape == (2,)

    def loss(values):
        with torch.no_grad():
            parameter.copy_(values)
        return camera.all_fields(images[:1]).double().var((-2, -1)).mean()

    start = parameter.detach().clone()
    loss(start).backward()
    expected = difference(lambda values: loss(values).detach(), start, 1e-4)
    torch.testing.assert_close(parameter.grad, expected.reshape(2), rtol=1e-2, atol=0)


def test_what_is_not_free_stays(lens, images):
    """A camera without free variables has no parameters."""
    camera = tasklens.Camera(*lens, {"thickness": [2]}, rays=64)
    optimizer = torch.optim.AdamW(camera.parameters(), lr=1e-2, weight_decay=0.1)
    camera(images).square().mean().backward()
    optimizer.step()
    moved, start = camera.lens, lens[0]
    assert torch.equal(moved.curvature, start.curvature) and torch.equal(moved.thickness[:2], start.thickness[:2])
    assert moved.thickness[2] != start.thickness[2]
    assert not list(tasklens.Camera(*lens, {}).parameters())
    for free in ({"radius": None}, {"curvature": [99]}, {"thickness": [0]}, {"conic": None}):  # 0 is the stop's
        with pytest.raises(InputError, match="free: "):
            tasklens.Camera(*lens, free)


def test_a_lens_and_a_network_are_trained_together(lens, images):
    """With one optimiser: the loss falls, the lens moves, and the penalty, zero at first, keeps its limits."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(3, 4, 3, 2), nn.ReLU(), nn.Flatten(), nn.Linear(900, 2))
    camera = tasklens.Camera(*lens, rays=128)
    assert camera.penalty() < 1e-12
    optimizer = torch.optim.Adam([*camera.parameters(), *network.parameters()], lr=1e-3)
    labels = torch.tensor([0, 1, 0, 1])
    losses = []
    for _ in range(20):
        loss = nn.functional.cross_entropy(network(camera(images)), labels)
        optimizer.zero_grad()
        (loss + 100 * camera.penalty()).backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]
    assert not torch.equal(camera.lens.curvature, lens[0].curvature)
    focal = tasklens.analyse(camera.lens.detached(), camera.view)["efl_mm"]
    assert focal == pytest.approx(lens[1].efl, rel=0.03)


def test_a_lens_without_light_is_refused(lens):
    """If all light is stopped, the network would see uniform grey."""
    dark = replace(lens[0], semi_diameter=torch.tensor([1.0, 1e-6, 1e-6], dtype=torch.float64))
    with pytest.raises(InputError, match="no light arrives at the field"):
        tasklens.Camera(dark, lens[1])
    with pytest.raises(InputError, match="dark: no light arrives at the field"):
        tasklens.rank({"dark": (dark, lens[1])}, [(torch.rand(3, 32, 32), k) for k in (0, 1)], nn.Flatten())


def test_fixed_psfs_are_called_like_a_lens(lens, images):
    """Fields by number, and the noise, are drawn alike from torch's default generator."""
    sensor = SensorSettings(full_well=100)
    camera = tasklens.Camera(*lens, rays=64, sensor=sensor)
    light = relative_illumination(lens[0], lens[1])
    fixed = tasklens.PsfCamera(tasklens.psf(*lens, rays=64).float(), sensor=sensor, illumination=light)
    for capture in (lambda c: c(images, [8, 0, 3, 8]), lambda c: c.all_fields(images)):
        captures = []
        for either in (camera, fixed, fixed):
            torch.manual_seed(len(captures) // 2)  # the third has other random numbers
            captures.append(capture(either))
        torch.testing.assert_close(captures[0], captures[1], rtol=0, atol=1 / 255 + 1e-6)
        assert not torch.equal(captures[1], captures[2])


def test_random_fields_are_of_the_whole_sensor(lens, images):
    """Nine of each call, drawn from torch's default generator, as are the field of each image and the noise."""
    sensor = SensorSettings(full_well=100)
    camera = tasklens.Camera(*lens, rays=64, sensor=sensor)
    captures = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        captures.append(camera(images))
    assert torch.equal(captures[0], captures[1]) and not torch.equal(captures[0], captures[2])
    torch.manual_seed(0)
    view = lens[1].at(drawn_points(1, seed=int(torch.randint(2**31, ()))))
    psf, light = tasklens.psf(lens[0], view, rays=64).float(), relative_illumination(lens[0], view)
    fixed = tasklens.PsfCamera(psf, sensor=sensor, illumination=light)
    torch.testing.assert_close(captures[0], fixed(images), rtol=0, atol=1 / 255 + 1e-6)


def test_a_state_belongs_to_its_initial_lens(lens, images):
    """Parameters are scaled by the initial lens: a camera built from the trained lens refuses them."""
    trained = tasklens.Camera(*lens, rays=64)
    with torch.no_grad():
        trained.variables["curvature"] += 0.1
    state = trained.state_dict()
    again = tasklens.Camera(*lens, rays=64)
    again.load_state_dict(state)
    assert torch.equal(again.lens.curvature, trained.lens.curvature)
    again.load_state_dict(state | {"_extra_state": state["_extra_state"] * (1 + 1e-12)})  # of another processor
    other = tasklens.Camera(trained.lens.detached(), lens[1], rays=64)
    with pytest.raises(InputError, match="load_state_dict: the state is that of a camera with another initial lens"):
        other.load_state_dict(state)


def test_compiled_captures_and_second_derivatives(lens, images):
    """Compilation leaves the camera out; a second derivative is refused, not zero."""
    camera = tasklens.Camera(*lens, rays=64)
    fields = torch.tensor([0, 8])
    compiled = torch.compile(camera, backend="eager")
    assert torch.equal(compiled(images[:2], fields), camera(images[:2], fields))
    curvature = camera.variables["curvature"]
    (first,) = torch.autograd.grad(camera(images[:2], fields).square().sum(), curvature, create_graph=True)
    with pytest.raises(tasklens.InputError, match="second derivatives"):
        torch.autograd.grad(first.sum(), curvature)


def test_half_precision_leaves_the_lens_alone(lens, images):
    """Captures have the type of the images; the lens keeps its double precision."""
    camera = tasklens.Camera(*lens, rays=64)
    before = camera.lens.curvature.detach().clone()
    nn.Sequential(camera, nn.Conv2d(3, 1, 3)).bfloat16()(images.bfloat16())
    assert torch.equal(camera.lens.curvature, before)
    assert camera(images.bfloat16()).dtype == camera.all_fields(images.bfloat16()).dtype == torch.bfloat16


def test_a_diverged_lens_is_reported(lens, images):
    camera = tasklens.Camera(*lens, rays=64)
    with torch.no_grad():
        camera.variables["curvature"] *= torch.nan
    with pytest.raises(InputError, match="curvature of the lens is not finite: the training diverged"):
        camera(images)
