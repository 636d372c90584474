"""Less than half of the light in the PSF window: every door says so, in the same words."""

import warnings
from dataclasses import replace

import pytest
import torch
from examples import HEADLINE, random_images, trained_network
from PIL import Image

import tasklens
from tasklens.cli.app import main
from tasklens.optics.psf import energy_inside, window_remark
from tasklens.study.run import screening

LENS = HEADLINE / "doublet-imaging3.yaml"
WORDS = "PSF window of .* holds only .* % of the light"


@pytest.fixture(scope="module")
def narrow():
    """A lens far out of focus, whose window holds little light."""
    lens, view = tasklens.load_lens(LENS, kernel_size=5)
    thickness = lens.thickness.clone()
    thickness[-1] += 0.2
    return replace(lens, thickness=thickness), view


@pytest.fixture
def files(narrow, tmp_path):
    """Files of the lens and of photographs."""
    tasklens.save_lens(tmp_path / "lens.yaml", *narrow)
    for name in ("cat", "dog"):
        (tmp_path / "photographs" / name).mkdir(parents=True)
        Image.new("RGB", (64, 64), (90, 120, 150)).save(tmp_path / "photographs" / name / "0.png")
    return tmp_path


IMAGES = torch.rand(3, 40, 60, generator=torch.Generator().manual_seed(0))
SHORT = {"descents": {"0": {"steps": 1}}, "rays": 16}
DOORS = {
    "psf": lambda pair: tasklens.psf(*pair, rays=64),
    "simulate": lambda pair: tasklens.simulate(*pair, IMAGES, rays=64),
    "simulate_whole_sensor": lambda pair: tasklens.simulate_whole_sensor(*pair, IMAGES, 0.2, rays=64),
    "camera": lambda pair: tasklens.Camera(*pair, rays=64),
    "rank": lambda pair: tasklens.rank({"mine": pair}, random_images(40, 16, 3, seed=2), trained_network(0), rays=64),
    "design_lens": lambda pair: tasklens.design_lens("spot", start=pair, settings=SHORT),
}
MORE = {  # words of a door
    "simulate_whole_sensor": f"{WORDS}.*take larger pixels of the image",  # its windows are of these
    "design_lens": f"design_lens: the {WORDS}",
}


@pytest.mark.parametrize("door", DOORS)
def test_python_warns(narrow, few_rays, door):
    with pytest.warns(UserWarning, match=MORE.get(door, WORDS)) as caught:
        DOORS[door](narrow)
    assert {record.filename for record in caught if "window" in str(record.message)} == {__file__}
    assert sum("window" in str(record.message) for record in caught) == 1
    with warnings.catch_warnings(action="error"):
        DOORS[door](tasklens.load_lens(LENS, kernel_size=31))


def test_a_camera_warns_once_when_training_loses_the_light(narrow):
    camera = tasklens.Camera(*tasklens.load_lens(LENS), rays=64)
    with torch.no_grad():
        camera.variables["thickness"][-1] += 0.2
    with pytest.warns(UserWarning, match=WORDS):
        camera(torch.rand(2, 3, 64, 64))
    with warnings.catch_warnings(action="error"):
        camera(torch.rand(2, 3, 64, 64))


def test_commands_say_so_in_a_line(files, capsys):
    """On standard error, once for a lens."""
    lens, photograph, folder = (str(files / name) for name in ("lens.yaml", "photographs/cat/0.png", "photographs"))
    rays = ("--rays", "64")
    for words in (
        ("lens", "simulate", lens, photograph, "-o", str(files / "capture.png"), *rays),
        ("lens", "psf", lens, "-o", str(files / "psf.npz"), *rays),
        ("lens", "captures", lens, folder, "-o", str(files / "captures"), "--size", "64", *rays),
        ("design", "--start", lens, "--set", "descents.0.steps=1", "-o", str(files / "better.yaml")),
    ):
        assert main(list(words)) == 0
        said = [line for line in capsys.readouterr().err.splitlines() if "PSF window" in line]
        assert len(said) == 1 and said[0].startswith(f"tasklens: {files}") and "Warning" not in said[0]


def test_the_ranking_command_says_so(files, capsys):
    screening.screen([files / "lens.yaml"], {"kernel_size": 3, "pixel_pitch_um": 0.3}, (), False)
    assert "lens.yaml: the PSF window of 3 x 3 pixels holds only" in capsys.readouterr().err


def test_half_of_the_light_is_enough():
    """The worst field counts, at the mean of its colours; vignetted light is not missing."""
    grid = torch.full((2, 3, 3, 3), 1 / 9)
    assert window_remark(energy_inside(grid), 3) == window_remark(torch.tensor([0.5]), 3) == ""
    grid[1, :2] *= 0.2
    assert "holds only 46.7 % of the light at the worst of 2 fields" in window_remark(energy_inside(grid), 3)
