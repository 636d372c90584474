"""Lenses without a positive focal length are shown and traced; what needs one says so."""

import json
import math

import pytest
import torch
from PIL import Image

import tasklens
from tasklens.cli.app import main
from tasklens.runtime.errors import InputError
from tasklens.study.run import screening

INF = math.inf
SURFACES = {
    "negative": [
        {"radius": -50.0, "thickness": 2.0, "material": "N-BK7", "stop": True, "semi_diameter": 3.0},
        {"radius": 60.0, "thickness": 10.0},
    ],
    "afocal": [  # a plane plate
        {"radius": INF, "thickness": 3.0, "material": "N-BK7", "stop": True, "semi_diameter": 3.0},
        {"radius": INF, "thickness": 10.0},
    ],
    "relay": [
        {"radius": 50.0, "thickness": 3.0, "material": "N-BK7", "stop": True, "semi_diameter": 3.0},
        {"radius": -50.0, "thickness": 150.0},
        {"radius": 50.0, "thickness": 3.0, "material": "N-BK7"},
        {"radius": -50.0, "thickness": 10.0},
    ],
}
NEEDS = r"focal length -.* a positive one; relays, negative and afocal lenses are only shown and traced"


def typed(name: str, **options):
    return tasklens.lens(SURFACES[name], field_of_view_deg=10, **options)


def test_rays_of_a_negative_lens_come_from_its_virtual_focus():
    """Paraxial rays leave as from a point 52.5 mm in front of the rear principal plane; those of a plate stay."""
    pupil = torch.tensor([[0.0, 1e-4]], dtype=torch.float64)
    lens, view = typed("negative")
    rays = tasklens.trace(lens, view.at([(0, 0)]), pupil=pupil)
    slope = float((rays.m / rays.n)[0, 1])
    efl = tasklens.analyse(lens, view, 64)["efl_mm"]
    assert slope == pytest.approx(-3e-4 / efl, rel=1e-6) and efl == pytest.approx(-52.45, abs=0.01)
    lens, view = typed("afocal")
    rays = tasklens.trace(lens, view, 16)
    torch.testing.assert_close(rays.m / rays.n, view.tangents[:, None, 1:].expand_as(rays.m), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("file", ["afocal.zmx", "relay.yaml"])
def test_they_are_read_and_shown(tmp_path, file, capsys):
    path, name = tmp_path / file, file.partition(".")[0]
    tasklens.save_lens(path, *typed(name))
    lens, view = tasklens.load_lens(path, field_of_view_deg=10)
    actual, expected = (tasklens.trace(*pair, 64).x for pair in ((lens, view), typed(name)))
    torch.testing.assert_close(actual, expected, rtol=1e-9, atol=1e-9)
    assert tasklens.psf(lens, view, 64).isfinite().all() and lens._repr_html_()
    drawn = [("draw", "-o", str(path.with_suffix(".png")))] if name == "afocal" else []
    for words in (("show",), ("analyse",), ("compare",), *drawn):
        assert main(["lens", words[0], str(path), "--rays", "64", *words[1:]]) == 0
        said = capsys.readouterr()
        assert path.suffix == ".yaml" or "not positive, so the lens is only shown and traced" in said.err
    assert main(["lens", "show", str(path), "--json", "--rays", "64"]) == 0
    shown = json.loads(capsys.readouterr().out)[str(path)]
    assert shown["track_mm"] > 0 and (shown["efl_mm"] is None or shown["efl_mm"] < 0)


@pytest.mark.parametrize("name", SURFACES)
def test_what_needs_a_positive_focal_length_says_so(name):
    lens, view = typed(name)
    image = torch.rand(3, 64, 64)
    for call in (
        lambda: tasklens.simulate(lens, view, image),
        lambda: tasklens.simulate_whole_sensor(lens, view, image),
        lambda: tasklens.Camera(lens, view),
        lambda: tasklens.rank({"mine": (lens, view)}, [(image, 0), (image, 1)], torch.nn.Flatten()),
        lambda: tasklens.design_lens("spot", start=(lens, view)),
        lambda: tasklens.lens([*SURFACES[name][:-1], {"radius": SURFACES[name][-1]["radius"]}], 10),
    ):
        with pytest.raises(InputError, match=NEEDS):
            call()


def test_commands_that_need_a_positive_focal_length_say_so(tmp_path, capsys):
    """In the last line, before anything is written."""
    path, relay, folder = tmp_path / "negative.zmx", tmp_path / "relay.yaml", tmp_path / "photographs"
    tasklens.save_lens(path, *typed("negative"))
    tasklens.save_lens(relay, *typed("relay"))
    folder.mkdir()
    Image.new("RGB", (64, 64)).save(folder / "0.png")
    for words in (
        ("lens", "simulate", str(path), str(folder / "0.png"), "-o", str(tmp_path / "capture.png")),
        ("lens", "captures", str(path), str(folder), "-o", str(tmp_path / "captures"), "--size", "64"),
        ("lens", "tolerance", str(path)),
        ("lens", "show", str(path), "--focus", "best"),
        ("lens", "show", str(relay), "--object-distance", "500"),
        ("design", "--start", str(path), "-o", str(tmp_path / "better.yaml")),
    ):
        assert main(list(words)) == 2
        assert "a positive one; relays, negative and afocal" in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "capture.png").exists() and not (tmp_path / "captures").exists()
    (reason,) = screening.screen([path], {}, (), False).left_out.values()
    assert "a ranking needs a positive one" in reason


def test_an_afocal_lens_has_no_f_number():
    surfaces = [{k: v for k, v in surface.items() if k != "semi_diameter"} for surface in SURFACES["afocal"]]
    with pytest.raises(InputError, match="semi_diameter: the radius of the stop is inf mm; expected"):
        tasklens.lens(surfaces, 10, f_number=4)
    lens, view = tasklens.lens([surfaces[0] | {"radius": -50.0}, surfaces[1] | {"radius": 60.0}], 10, f_number=4)
    assert tasklens.analyse(lens, view, 64)["f_number"] == pytest.approx(-4, rel=1e-6)
