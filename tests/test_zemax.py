"""Reading Zemax files: their contents, and lines that change rays."""

import math

import pytest
import torch
from examples import f64, parallel_rays
from prescriptions import tensors
from zemax_texts import edit, read_lens

from tasklens.materials.catalogues import builtin
from tasklens.materials.material import AIR, model_glass
from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import FIELDS
from tasklens.optics.tracing.trace import trace_full
from tasklens.runtime.files import FileError


def test_what_a_file_says(tmp_path):
    imported = read_lens(tmp_path)
    lens = imported.lens
    assert lens.curvature.tolist() == [0.25, -0.1, 0.0, 0.1, 0.0]
    assert lens.conic.tolist() == [-0.5, 0.0, 0.0, 0.0, 0.0]
    assert lens.alpha[0].tolist() == [0.01, -0.002, 0, 0, 0, 0, 0, 1e-6] and not lens.alpha[1:].any()
    assert lens.thickness.tolist() == [0.8, 0.3, 0.2, 0.6, 2.5]
    assert lens.media == (builtin("COC"), AIR, AIR, model_glass(1.64, 23.3, 0.01), AIR)
    assert lens.stop == 2
    semi = lens.semi_diameter.tolist()
    assert semi[:2] == [math.inf, 0.8] and semi[3:] == [1.1, math.inf]  # automatic, fixed; floating aperture, none
    assert (imported.title, imported.comments) == ("A doublet", ("front  lens", "", "", "", ""))
    assert imported.aperture == ("entrance_pupil_diameter_mm", 1.2)
    assert imported.fields == ("angle_deg", ((0.0, 0.0), (1.5, 20.0)))
    assert (imported.wavelengths_um, imported.primary) == ((0.6563, 0.5893, 0.4861), 1)


@pytest.mark.parametrize(
    "distance, unit, expected", [("350", "MM", 350.0), ("2", "IN", 50.8), ("1E+10", "MM", math.inf)]
)
def test_the_distance_of_the_object(tmp_path, distance, unit, expected):
    """In the file's unit; beyond Zemax's limit the object is at infinity. The lens itself is the same."""
    imported = read_lens(tmp_path, edit(("DISZ INFINITY", f"DISZ {distance}"), ("UNIT MM", f"UNIT {unit}")))
    far = read_lens(tmp_path, edit(("UNIT MM", f"UNIT {unit}")))
    assert imported.object_distance_mm == pytest.approx(expected, rel=1e-15) and math.isinf(far.object_distance_mm)
    assert all(torch.equal(a, b) for a, b in zip(*map(tensors, (imported.lens, far.lens)), strict=True))


@pytest.mark.parametrize("line", ["ENPD 1.2", "FNUM 2.8 0"])
def test_the_stop_is_what_the_aperture_asks_for(tmp_path, line):
    """A real ray close to the axis, scaled up to the rim of the pupil, meets the rim of the stop."""
    lens = read_lens(tmp_path, edit(("ENPD 1.2", line))).lens
    h = 1e-5
    ray, record = trace_full(lens, parallel_rays([h]), lens.refractive_indices((0.5893,)))
    efl = -h / float(ray.m / ray.n)
    pupil_radius = 0.6 if line.startswith("ENPD") else efl / 2.8 / 2
    assert float(lens.semi_diameter[2]) == pytest.approx(float(record[2].y) / h * pupil_radius, rel=1e-8)


def test_a_floating_aperture_is_the_size_of_the_stop(tmp_path):
    imported = read_lens(tmp_path, edit(("ENPD 1.2", "FLOA")))
    assert imported.aperture is None and float(imported.lens.semi_diameter[2]) == 0.55


@pytest.mark.parametrize("aperture", ["ENPD 1.2", "FLOA"])
@pytest.mark.parametrize(
    "line",
    ["DIAM 0.55 0 0 0 1\n  CLAP 0 0.4 0", "DIAM 0.4 1 0 0 1\n  CLAP 0 0.4 0", "DIAM 0.4 1 0 0 1\n  FLAP 0 0.4 0"],
)
def test_a_stop_that_vignettes_at_less_than_the_aperture_asks_for(tmp_path, aperture, line):
    """As in Edmund Optics' 47728: a pupil of 15 mm, and 13.5 mm clear at the stop."""
    imported = read_lens(tmp_path, edit(('DIAM 0.55 0 0 0 1 ""', line), ("ENPD 1.2", aperture)))
    assert imported.aperture is None and float(imported.lens.semi_diameter[2]) == 0.4
    zemax.write(tmp_path / "lens.zmx", imported)
    assert torch.equal(zemax.read(tmp_path / "lens.zmx").lens.semi_diameter, imported.lens.semi_diameter)


@pytest.mark.parametrize("line", ["DIAM 0.55 0 0 0 1\n  CLAP 0 0.9 0", "DIAM 0.5 0 0 0 1\n  FLAP 0 0.5 0"])
def test_a_stop_that_vignettes_nothing_keeps_the_aperture(tmp_path, line):
    expected = read_lens(tmp_path)
    actual = read_lens(tmp_path, edit(('DIAM 0.55 0 0 0 1 ""', line)))
    assert actual.aperture == expected.aperture
    assert torch.equal(actual.lens.semi_diameter, expected.lens.semi_diameter)


@pytest.mark.parametrize(
    "line, radius",
    [
        ("DIAM 0.8 0 0 0 1", math.inf),  # automatic
        ("DIAM 0.8 1 0 0 1", 0.8),  # fixed
        ("DIAM 0.8 2 1 0 1", 0.8),  # picked up
        ("DIAM 0.8 0 0 0 1\n  CLAP 0 0.7 0", 0.7),
        ("DIAM 0.8 1 0 0 1\n  FLAP 0 0.8 0", 0.8),
    ],
)
def test_which_radii_clip(tmp_path, line, radius):
    assert float(read_lens(tmp_path, edit(("DIAM 0.8 1 0 0 1", line))).lens.semi_diameter[1]) == radius


@pytest.mark.parametrize("flag", [1, 2])
def test_a_fixed_semi_diameter_clips_where_the_surface_refracts(tmp_path, flag):
    """OpticStudio has no floating aperture on a surface without power: neither a dummy plane nor a stop in air."""
    expected = read_lens(tmp_path)
    last = ("  CURV 0\n  DISZ 2.5", f"  CURV 0\n  DISZ 2.5\n  DIAM 0.1 {flag}")
    actual = read_lens(tmp_path, edit(("DIAM 0.55 0", f"DIAM 0.4 {flag}"), last))
    assert actual.aperture == expected.aperture
    semi = actual.lens.semi_diameter.tolist()
    assert semi[2] == float(expected.lens.semi_diameter[2]) and semi[4] == 0.1  # surface 5 ends the glass of surface 4
    dummy = read_lens(tmp_path, edit(("DIAM 0.55 0", f"DIAM 0 {flag}"))).lens
    assert torch.equal(dummy.semi_diameter, expected.lens.semi_diameter)


@pytest.mark.parametrize("unit, factor", [("CM", 10.0), ("IN", 25.4), ("METER", 1000.0)])
@pytest.mark.parametrize("kind", range(4))
def test_units(tmp_path, unit, factor, kind):
    """In other units the file describes a lens of another size: every length scales, angles and conics do not."""
    text = edit(("FTYP 0 0", f"FTYP {kind} 0"))
    small, large = read_lens(tmp_path, text), read_lens(tmp_path, text.replace("UNIT MM", f"UNIT {unit}"))
    a, b = small.lens, large.lens
    for name in ("thickness", "semi_diameter"):
        torch.testing.assert_close(getattr(b, name), factor * getattr(a, name), rtol=1e-12, atol=0)
    torch.testing.assert_close(b.curvature, a.curvature / factor, rtol=1e-15, atol=0)
    powers = f64([factor ** (1 - 2 * j) for j in range(1, 9)])
    torch.testing.assert_close(b.alpha, a.alpha * powers, rtol=1e-14, atol=0)
    assert torch.equal(a.conic, b.conic) and large.aperture[1] == 1.2 * factor
    scale = 1.0 if kind == 0 else factor
    assert small.fields[0] == large.fields[0] == FIELDS[kind]
    assert large.fields[1] == ((0.0, 0.0), (1.5 * scale, 20 * scale))


def test_an_f_number_has_no_unit(tmp_path):
    small = read_lens(tmp_path, edit(("ENPD 1.2", "FNUM 2.8 0")))
    large = read_lens(tmp_path, edit(("ENPD 1.2", "FNUM 2.8 0"), ("UNIT MM", "UNIT IN")))
    assert small.aperture == large.aperture == ("f_number", 2.8)
    ratio = large.lens.semi_diameter[2] / small.lens.semi_diameter[2]
    assert float(ratio) == pytest.approx(25.4, rel=1e-12)


def test_extended_aspheres_are_normalised(tmp_path):
    """sum_j a_j (r / 2)^2j: alpha_2j = a_j / 4^j."""
    lines = "  XDAT 1 1.2E+01\n  XDAT 2 2\n  XDAT 4 0.5 0 0 1\n  XDAT 14 -0.25"
    changes = [("EVENASPH", "XASPHERE"), ("  PARM 1 0.01\n  PARM 2 -0.002\n  PARM 8 1e-06", lines)]
    alpha = read_lens(tmp_path, edit(*changes)).lens.alpha
    assert alpha[0].tolist() == [0, 0.5 / 4**2, *[0] * 9, -0.25 / 4**12]


def test_an_extended_asphere_without_terms_is_an_even_one(tmp_path):
    """Converters of patents write XASPHERE with PARM; a file with terms and parameters is refused."""
    terms = "  PARM 1 0.01\n  PARM 2 -0.002\n  PARM 8 1e-06"
    even, extended = read_lens(tmp_path), read_lens(tmp_path, edit(("EVENASPH", "XASPHERE")))
    assert all(torch.equal(a, b) for a, b in zip(tensors(extended.lens), tensors(even.lens), strict=True))
    assert extended.remarks == ("surface 1 is an XASPHERE without terms in XDAT: PARM is read as of EVENASPH",)
    ten = read_lens(tmp_path, edit(("EVENASPH", "XASPHERE"), (terms, "  XDAT 1 0\n  PARM 10 2e-9"))).lens
    assert ten.alpha[0].tolist() == [0] * 9 + [2e-9]
    assert read_lens(tmp_path, edit(("EVENASPH", "XASPHERE"), (terms, "  PARM 2 0"))).remarks == ()
    for lines in ("  XDAT 1 2\n  XDAT 2 1\n  PARM 2 0.1", "  PARM 13 3"):
        with pytest.raises(FileError, match=r"PARM: XASPHERE with \d terms has no term number"):
            read_lens(tmp_path, edit(("EVENASPH", "XASPHERE"), (terms, lines)))


def test_the_catalogue_that_the_file_names_first_defines_a_glass(tmp_path):
    """GCAT SECOND FIRST sets the order of catalogues, whatever the order of the paths; built-in plastics come last."""
    paths = []
    (tmp_path / "elsewhere").mkdir()  # catalogues in the folder of the lens need no path
    for name, index in (("FIRST", 1.4), ("second", 1.6), ("THIRD", 1.7)):
        paths.append(tmp_path / "elsewhere" / f"{name}.agf")
        paths[-1].write_text(f"NM COC 5 0 1.5 50\nCD {index} 0 0\nLD 0.4 0.8\n")
    for order in (paths, paths[::-1]):
        assert read_lens(tmp_path, catalogues=order).lens.media[0].source == "second.agf"
    assert read_lens(tmp_path, catalogues=paths[2:]).lens.media[0].source == "THIRD.agf"


def test_glasses_are_picked_up_and_labelled(tmp_path):
    """Solve 2 takes the glass of another surface; solve 1 is a model whatever the name says."""
    lens = read_lens(tmp_path, edit(("___BLANK 1 0 1.64 23.3 0.01", "COC 2 1 1.5 40"))).lens
    assert lens.media[3] == builtin("COC")
    lens = read_lens(tmp_path, edit(("COC 0 0 1.5 40", "COC 1 0 1.5 40"), ("___BLANK 1 0", "___BLANK 2 1"))).lens
    assert lens.media[0] == lens.media[3] == model_glass(1.5, 40.0, 0.0, "COC")
    assert lens.media[0].refractive_index(0.5875618) == 1.5 and lens.media[0].name.startswith("COC ")


@pytest.mark.parametrize("kind, keyword, first", [("XOSPHERE", "XDAT", 3), ("ODDASPHE", "PARM", 1)])
def test_an_odd_asphere_without_odd_terms_is_an_even_one(tmp_path, kind, keyword, first):
    """Term j of both kinds multiplies r^j."""
    head = "  XDAT 1 6\n  XDAT 2 1\n" if kind == "XOSPHERE" else ""
    terms = [0.0, 0.01, 0.0, -0.002, 0.0, 1e-6]
    lines = head + "\n".join(f"  {keyword} {first + j} {value}" for j, value in enumerate(terms))
    changes = ("EVENASPH", kind), ("  PARM 1 0.01\n  PARM 2 -0.002\n  PARM 8 1e-06", lines)
    assert read_lens(tmp_path, edit(*changes)).lens.alpha[0].tolist() == [0.01, -0.002, 1e-6]
    odd = edit(changes[0], (changes[1][0], lines.replace(f"{keyword} {first + 2} 0.0", f"{keyword} {first + 2} 0.1")))
    with pytest.raises(FileError, match=f"{keyword}: odd terms"):
        read_lens(tmp_path, odd)


def test_fields_of_old_files_and_more_than_twelve(tmp_path):
    expected = read_lens(tmp_path).fields
    assert read_lens(tmp_path, edit(("XFLN", "XFLD"), ("YFLN", "YFLD"))).fields == expected
    assert read_lens(tmp_path, edit(("XFLN 0 1.5", "XFLN 0 1.5\nXFLD 0 1.5"))).fields == expected
    heights = [float(i) for i in range(14)]
    twelve = " ".join(map(str, heights[:12]))
    further = "".join(f"FEFD {i + 1} 0 {height} 1 0 0 0 0 0\n" for i, height in enumerate(heights))
    changes = [("FTYP 0 0 2 3 0 0 0 2", "FTYP 0 0 14 3 0 0 0 2"), ("XFLN 0 1.5", f"XFLN{12 * ' 0'}")]
    fields = read_lens(tmp_path, edit(*changes, ("YFLN 0 20\n", f"YFLN {twelve}\n{further}"))).fields
    assert fields == ("angle_deg", tuple((0.0, height) for height in heights))
    with pytest.raises(FileError, match="FEFD: differs from field 3"):
        read_lens(tmp_path, edit(*changes, ("YFLN 0 20\n", f"YFLN {twelve}\n{further.replace('3 0 2.0', '3 0 2.5')}")))


def test_a_glass_that_no_catalogue_has_is_that_of_its_line(tmp_path):
    """The glass has nd and Vd of its line, with a remark; nd = Vd = 0 is refused (`MISTAKES`)."""
    for dpgf, error in ((0.0, "4e-4"), (0.01, "1e-4")):
        imported = read_lens(tmp_path, edit(("COC 0 0 1.5 40", f"MINE 0 0 1.52 40 {dpgf}")))
        assert imported.lens.media[0] == model_glass(1.52, 40.0, dpgf, "MINE")
        (remark,) = imported.remarks
        assert remark.startswith(
            "glass MINE is in no catalogue: using a model glass with nd = 1.52 and Vd = 40, as its line says"
        )
        assert f"its index is right to {error} in the visible. The nearest glass is " in remark
    with pytest.raises(FileError, match="MINE"):  # 1.5 and 40 stand for any glass of a catalogue
        read_lens(tmp_path, edit(("COC 0 0 1.5 40", "MINE 0 0 1.5 40")))
    assert read_lens(tmp_path).remarks == ()


def test_data_of_the_file_that_are_ignored_are_remarks(tmp_path):
    """Vignetting factors and unequal weights of wavelengths change figures in Zemax; neutral ones are no remark."""
    neutral = edit(("XFLN 0 1.5", "XFLN 0 1.5\nVCYN 0 0\nVDYN 0 0"), ("WAVM 4 0.55 1", "WAVM 4 0.55 7"))
    assert read_lens(tmp_path, neutral).remarks == ()
    changes = ("XFLN 0 1.5", "XFLN 0 1.5\nVCYN 0 0.2"), ("WAVM 2 0.5893 1", "WAVM 2 0.5893 0.3")
    factors, weights = read_lens(tmp_path, edit(*changes)).remarks
    assert factors.startswith("vignetting factors are ignored") and weights.startswith("weights of wavelengths")
    for keyword in ("WWGN", "WWGT"):
        (weights,) = read_lens(tmp_path, edit(("XFLN 0 1.5", f"XFLN 0 1.5\n{keyword} 1 5 1"))).remarks
        assert weights == "weights of wavelengths are ignored: all weigh the same"
    (stop,) = read_lens(tmp_path, edit(('DIAM 0.55 0 0 0 1 ""', "CLAP 0 0.3 0"))).remarks
    assert stop == "clear aperture of the stop, 0.3 mm: smaller than ENPD gives, 0.5201 mm"
