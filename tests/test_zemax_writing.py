"""Writing Zemax files: they read back the same to the last bit, and what they cannot hold is refused."""

import math
from dataclasses import replace

import pytest
import torch
import yaml
from examples import f64, make_lens, materials
from prescriptions import same_bits

from tasklens.materials import catalogues
from tasklens.materials.material import AIR, Material, model_glass
from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import FIELDS, Prescription
from tasklens.optics.io.stop import stop_radius
from tasklens.optics.lens import Lens
from tasklens.runtime.files import FileError

MINE = Material("MINE", "conrady", (1.5, 0.01, 0.002), (0.4, 0.8), "maker")


def random_prescription(seed: int) -> Prescription:
    """Spheres, even aspheres and aspheres beyond r^16, glasses of every kind, all kinds of fields and apertures."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> torch.Tensor:
        return 2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1

    kinds = (*materials("COC", "OKP4"), MINE, model_glass(1.6, 30.1, 0.0), model_glass(1.7, 20.0, 0.01, "EP_BLANK"))
    glass = torch.randint(len(kinds), (3,), generator=generator).tolist()
    alpha = rand(6, 11) * 0.1 ** f64(range(1, 12))
    alpha[0], alpha[1, 3:], alpha[2, 8:] = 0.0, 0.0, 0.0
    lens = make_lens(
        0.3 * rand(6),
        0.5 + 0.4 * rand(6),
        [AIR, kinds[glass[0]], kinds[glass[1]], AIR, kinds[glass[2]], AIR],
        conic=2 * rand(6),
        alpha=alpha,
        semi_diameter=[0.7 + seed / 3, math.inf, 1 / 3, math.pi, math.inf, 1.1],
        stop=int(torch.randint(6, (), generator=generator)),
    )
    aperture = (None, ("f_number", 2.8 + float(rand(1)) / 3), ("entrance_pupil_diameter_mm", 1.1))[seed % 3]
    wavelengths = (0.4861 + seed / 1e3, 0.5893, 0.6563)
    lens.semi_diameter[lens.stop] = 0.3 if aperture is None else stop_radius(lens, aperture, wavelengths[seed % 3])
    return Prescription(
        lens=lens,
        title=("", "yes: no", "Ø 3 mm")[seed % 3],
        comments=("front", "", "12", "a  b", "", "µ") if seed % 2 else None,
        aperture=aperture,
        fields=(FIELDS[seed % 4], tuple(map(tuple, (30 * rand(1 + seed, 2)).tolist()))),
        wavelengths_um=wavelengths,
        primary=seed % 3,
        object_distance_mm=(math.inf, 1000 / 3)[seed // 2 % 2],
    )


def without_sources(lens: Lens) -> Lens:
    """The lens without the sources of its materials, which a catalogue does not hold."""
    return replace(lens, media=tuple(replace(medium, source="") for medium in lens.media))


@pytest.mark.parametrize("seed", range(5))
def test_round_trip_keeps_every_bit(tmp_path, seed):
    original = random_prescription(seed)
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({"MINE": MINE.definition()}))
    zemax.write(tmp_path / "lens.zmx", original)
    copy = zemax.read(tmp_path / "lens.zmx", [tmp_path / "mine.yaml"])
    assert replace(copy, lens=None) == replace(original, lens=None)
    assert same_bits(without_sources(copy.lens), without_sources(original.lens))


def test_a_written_file_has_what_opticstudio_looks_for(tmp_path):
    original = random_prescription(4)
    zemax.write(tmp_path / "lens.zmx", replace(original, title="T"))
    lines = (tmp_path / "lens.zmx").read_bytes().decode("ascii", "replace").split("\r\n")
    assert f"FNUM {original.aperture[1]:.17g} 0" in lines  # 0: F-number in image space
    for start in ("VERS ", "MODE SEQ", "NAME T", "UNIT MM", "FTYP 0 0 5 3", "XFLN ", "YFLN ", "PWAV 2"):
        assert any(line.startswith(start) for line in lines), start
    assert [line for line in lines if line.startswith("SURF")] == [f"SURF {i}" for i in range(8)]
    assert sum(line == "  STOP" for line in lines) == 1
    assert {line.split()[1] for line in lines if line.startswith("  TYPE")} == {"STANDARD", "EVENASPH", "XASPHERE"}


def test_real_rays_fill_an_inner_stop(tmp_path):
    """Ray aiming of a written file is Real (2) if a surface is in front of the stop."""
    stops = {}
    for seed in range(8):
        original = replace(random_prescription(seed), title="", comments=None)
        zemax.write(tmp_path / "lens.zmx", original)
        stops[original.lens.stop] = "RAIM 0 2 " in (tmp_path / "lens.zmx").read_text("ascii")
    assert 0 in stops and len(stops) > 1 and all(is_aimed == (stop > 0) for stop, is_aimed in stops.items())


@pytest.mark.parametrize(
    "change, words",
    [
        ({"fields": None}, ["fields"]),
        ({"wavelengths_um": None}, ["wavelengths"]),
        ({"wavelengths_um": (0.5,) * 25}, ["24"]),
        ({"title": "two\nlines"}, ["one line", "two"]),
        ({"comments": ("", " a", "", "", "", "")}, ["one line", " a"]),
        ({"aperture": ("f_number", 1.0)}, ["f_number 1.0", "stop", "mm"]),
        ({"aperture": None, "lens": make_lens([0.1], [1.0], ("COC",))}, ["radius of its stop"]),
    ],
)
def test_what_a_file_cannot_hold_is_refused(tmp_path, change, words):
    with pytest.raises(FileError) as error:
        zemax.write(tmp_path / "lens.zmx", replace(random_prescription(1), **change))
    assert all(word in str(error.value) for word in words), error.value
    assert not (tmp_path / "lens.zmx").exists()


def test_glasses_have_the_names_of_opticstudio(tmp_path):
    """Polystyrene is POLYSTYR of MISC there; a catalogue beside the file has the other plastics."""
    original = random_prescription(1)
    media = (*materials("PS", "COC", "OKP4HT", "OKP4"), MINE, AIR)
    zemax.write(tmp_path / "lens.zmx", replace(original, aperture=None, lens=replace(original.lens, media=media)))
    lines = (tmp_path / "lens.zmx").read_bytes().decode("latin-1").replace("\0", "").split("\r\n")
    assert "GCAT LENS MISC PLASTIC2022" in lines
    names = [line.split()[1] for line in lines if line.startswith("  GLAS")]
    assert names == ["POLYSTYR", "COC", "OKP4HTL", "OKP4", "MINE"]
    read_media = zemax.read(tmp_path / "lens.zmx").lens.media
    assert read_media[:3] == media[:3]
    assert read_media[3:] == (*(replace(medium, source="lens.agf") for medium in media[3:5]), AIR)
    (tmp_path / "copy.zmx").write_bytes((tmp_path / "lens.zmx").read_bytes())
    copied = zemax.read(tmp_path / "copy.zmx").lens.media  # its GCAT names lens.agf
    assert [medium.coefficients for medium in copied] == [medium.coefficients for medium in read_media]
    (tmp_path / "lens.agf").unlink()
    without = zemax.read(tmp_path / "lens.zmx")
    assert without.lens.media[4].abbe() == pytest.approx(MINE.abbe(), rel=1e-12)
    assert "glass MINE is in no catalogue: using a model glass with nd =" in without.remarks[0]


def test_a_catalogue_has_nd_and_vd_for_lists(tmp_path):
    """Those of polystyrene as in Zemax's own catalogue; none where the fit does not reach the visible lines."""
    infrared = Material("IR", "conrady", (1.5, 0.01, 0.002), (0.8, 2.0))
    catalogues.write_agf(tmp_path / "m.agf", [*materials("PS"), infrared])
    heads = [line.split() for line in (tmp_path / "m.agf").read_text().splitlines() if line.startswith("NM")]
    assert heads[0][1:4] == ["PS", "1", "0"] and heads[1][4:6] == ["0.000000", "0.000000"]
    assert [float(word) for word in heads[0][4:6]] == pytest.approx([1.590481, 30.866877], rel=1e-5)


@pytest.mark.parametrize("name", ["MY GLASS", "MIRROR", "___BLANK"])
def test_a_glass_that_zemax_cannot_name_is_refused(tmp_path, name):
    glass = Material(name, "conrady", (1.5, 0.0, 0.0), (0.4, 0.8))
    lens = replace(random_prescription(0).lens, media=(glass,) * 6)
    with pytest.raises(FileError, match=name):
        zemax.write(tmp_path / "lens.zmx", replace(random_prescription(0), lens=lens))
