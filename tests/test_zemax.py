"""Reading Zemax files: their contents, and lines that change rays are read, or refused with their number."""

import codecs
import math

import pytest
import torch
from examples import f64, parallel_rays
from prescriptions import tensors
from zemax_texts import LENS_TEXT, edit, read_lens

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
@pytest.mark.parametrize("line", ["DIAM 0.55 0 0 0 1\n  CLAP 0 0.4 0", "DIAM 0.4 1 0 0 1\n  CLAP 0 0.4 0"])
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


MISTAKES = [
    ("CURV 0.25", "CURV 0.2.5", ["line 22", "CURV", "0.2.5"]),
    ("CURV 0.25", "CURV nan", ["line 22", "nan"]),
    ("  CURV -0.1\n", "", ["SURF", "surface 2", "no CURV"]),
    ("DISZ 0.8", "DISZ INFINITY", ["line 26", "INFINITY"]),
    ("DISZ 0.8", "DISZ", ["line 26", "DISZ"]),
    ("PARM 2 -0.002", "PARM two 1", ["line 24", "PARM", "two"]),
    ("DISZ INFINITY", "DISZ 0", ["line 18", "0", "INFINITY"]),
    ("  STOP\n", "", ["STOP", "0"]),
    ("  DISZ 2.5", "  DISZ 2.5\n  STOP", ["STOP", "2"]),
    ("TYPE EVENASPH", "TYPE COORDBRK", ["line 21", "COORDBRK", "EVENASPH"]),
    ("TYPE EVENASPH", "TYPE XASPHERE\n  XDAT 1 3", ["line 21", "XDAT 2"]),
    ("COC 0 0 1.5 40", "MIRROR 0 0 1.5 40", ["line 27", "mirror"]),
    ("COC 0 0 1.5 40", "UNOBTAINIUM", ["line 27", "UNOBTAINIUM", "built-in plastics", "--catalogue"]),
    ("COC 0 0 1.5 40", "COC 4 0 1.5 40", ["line 27", "offset"]),
    ("COC 0 0 1.5 40", "COC 2 3 1.5 40", ["line 27", "surface 3"]),
    ("1.64 23.3", "0.64 23.3", ["GLAS", "0.64"]),
    ("FLAP 0 1.1", "FLAP 0.2 1.1", ["FLAP", "hole"]),
    ("FLAP 0 1.1 0", "SQAP 1 1", ["SQAP", "round"]),
    ("MODE SEQ", "MODE NSC", ["line 2", "NSC"]),
    ("MNUM 1 1", "MNUM 3 4", ["line 55", "1 .. 3", "4"]),
    ("UNIT MM", "UNIT PARSEC", ["line 4", "PARSEC", "MM"]),
    ("ENPD 1.2", "OBNA 0.1", ["aperture", "ENPD"]),
    ("ENPD 1.2", "ENPD 0", ["line 5", "positive"]),
    ("FTYP 0 0 2 3", "FTYP 4 0 2 3", ["line 7", "4"]),
    ("FTYP 0 0 2 3", "FTYP 0 0 3 3", ["line 8", "3 values"]),
    ("FTYP 0 0 2 3", "FTYP 0 0 2 5", ["5 wavelengths"]),
    ("WAVM 2 0.5893", "WAVM 2 3.4", ["3.4", "COC"]),
    ("PWAV 2", "PWAV 4", ["PWAV", "4"]),
    ("YFLN 0 20\n", "", ["YFLN"]),
    ("SURF 4", "SURF 5", ["line 40", "surface 4"]),
    ("  CURV 0\n  DISZ 0\n", "  CURV 0.1\n  DISZ 0\n", ["SURF", "image", "curved"]),
]


@pytest.mark.parametrize("old, new, words", MISTAKES, ids=[new.strip() or f"no {old}" for old, new, _ in MISTAKES])
def test_a_mistake_is_refused_with_its_line(tmp_path, old, new, words):
    with pytest.raises(FileError) as error:
        read_lens(tmp_path, edit((old, new)))
    assert all(word in str(error.value) for word in ["lens.zmx", *words]), error.value


CUT_OFF = [LENS_TEXT[: LENS_TEXT.index(end)] for end in ("SURF 4", "SURF 5", "SURF 6", "  DISZ 2.5")]


@pytest.mark.parametrize("text", ["", "hello", "\0\0\0", "SURF x\n", *CUT_OFF])
def test_what_is_no_whole_lens_file_is_refused(tmp_path, text):
    """Of a file that is cut off, the last surface is not an image surface."""
    with pytest.raises(FileError, match=r"lens\.zmx"):
        read_lens(tmp_path, text)


def assert_refused(tmp_path, text: str, line: str, *words: str, encoding: str = "utf-8") -> None:
    """Reading fails with the file, the number of the line that is exactly `line`, and `words`."""
    number = text.split("\n").index(line) + 1
    with pytest.raises(FileError) as error:
        read_lens(tmp_path, text, encoding=encoding)
    message = str(error.value)
    assert all(word in message for word in (f"lens.zmx, line {number}: {line.split()[0]}", *words)), message


def test_the_paraxial_working_f_number(tmp_path):
    """1 / (2 tan u) of the marginal ray; with the object at infinity that is the F-number in image space, efl / D."""
    working, image = (read_lens(tmp_path, edit(("ENPD 1.2", f"FNUM 2.8 {kind}"))) for kind in (1, 0))
    assert working.aperture == image.aperture == ("f_number", 2.8)
    assert all((a == b).all() for a, b in zip(tensors(working.lens), tensors(image.lens), strict=True))
    near = edit(("ENPD 1.2", "FNUM 2.8 1"), ("DISZ INFINITY", "DISZ 350"))
    assert_refused(tmp_path, near, "FNUM 2.8 1", "near object", "ENPD")
    assert_refused(tmp_path, edit(("ENPD 1.2", "FNUM 2.8 2")), "FNUM 2.8 2", "type")
    assert read_lens(tmp_path, edit(("ENPD 1.2", "FNUM 2.8"))).aperture == image.aperture  # files that we wrote before


SYSTEM = [
    ("ENVD 60 1 0", "20 deg C"),
    ("ENVD 20 0 0", "1 atm"),
    ("GFAC 1 2", "apodis"),
    ("FNUM 2.8 0", "ENPD as well"),
    ("TELE 1", "telecentric"),
    ("AFOC 1", "afocal"),
    ("TEMP 60", "20 deg C"),
    ("PRES 0", "1 atm"),
    ("WHAT 1 2", "unknown keyword"),
]
SURFACE = [
    ("OBDC 0 0.5", "decentred"),
    ("IGNR 1", "ignored"),
    ("HIDE 0 0 0 0 0 0 0 0 0 1", "flags"),
    ("SCBD 1 0 0 0 0 90 0 0", "tilted"),
    ("ELOB 0.5 0.2", "round"),
    ("USAP 1", "round"),
    ("WHAT 1 2", "delete the line"),
    ("NSOH NSC_SRCE 0 0", "non-sequential"),
    ("NSOP 1 0 0 0", "non-sequential"),
    ("TYPE NONSEQCO", "non-sequential"),
    ("CURV 0.3", "already"),
    ("XDAT 1 0.5", "STANDARD"),
    ("CLAP 0 -0.5 0", "radius"),
]
FTYP = "FTYP 0 0 2 3 0 0 0 2"
LINES = [  # a line of the text, what is in its place, and a word of the message about the last line
    (FTYP, "FTYP 0 1 2 3 0 0 0 2", "telecentric"),
    (FTYP, "FTYP 0 0 2 3 0 0 1 2", "afocal"),
    (FTYP, "FTYP 0 0 2.5 3 0 0 0 2", "integer"),
    (FTYP, "FTYP 0 0 -2 3 0 0 0 2", "at least one field"),
    ("  PARM 2 -0.002", "  PARM 2 1e400", "range of float64"),
    ("  PARM 2 -0.002", "  PARM 2 inf", "inf"),
    ("  PARM 8 1e-06", "  PARM 9 1e-06", "8 terms"),
    ("  PARM 8 1e-06", "  PARM 1.5 1e-06", "integer"),
    ("WAVM 2 0.5893 1", "WAVM 2 -0.5893 1", "positive wavelengths"),
    *(("MODE SEQ", f"MODE SEQ\n{line}", word) for line, word in SYSTEM),
    *(("  CURV -0.1", f"  CURV -0.1\n  {line}", word) for line, word in SURFACE),
]


@pytest.mark.parametrize("old, new, word", LINES)
def test_a_line_that_changes_rays_or_is_out_of_range_is_refused(tmp_path, old, new, word):
    assert_refused(tmp_path, edit((f"{old}\n", f"{new}\n")), new.split("\n")[-1], word)


@pytest.mark.parametrize("line, word", [pair for pair in SURFACE if pair[0].startswith(("OBDC", "SCBD", "CURV"))])
def test_data_of_a_surface_behind_the_surfaces(tmp_path, line, word):
    assert_refused(tmp_path, edit(("MNUM 1 1", f"{line}\nMNUM 1 1")), line, "belongs to a surface")


@pytest.mark.parametrize("apodisation", ["GFAC 0 3", "GFAC 1 0"])  # none, by its kind and by its strength
def test_what_changes_no_ray_changes_nothing(tmp_path, apodisation):
    """Neutral values, drawing, solves whose value stands in the file, merit functions."""
    system = f"NOTE 0 text\nENVD 2.0E+1 1 1\n{apodisation}\nPUSH 1 2 3 0 0 0\nRAIM 0 2 1 1 0 0 0 0 0 1\nSTUD 1\n"
    system += "FSVY 2 3\nCHZH 0 0\nFENF 1 3 4\nFENF 2 3 4"
    surface = "  BMRK 1\n  BKMK 1\n  BOOK 1\n"
    surface += "  HIDE 1 1 1 1 0 0 0 0 0 0\n  OBDC 0.0 0.0\n  IGNR 0\n  PZUP 1 1 0 0\n  COAT AR\n  MIRR 2 0\n  FIMP \n"
    end = "WFNO 0 0 0 0 0 0 0 0 0 0\nMNUM 1 1\nIGNR   2   1 0 0 0 0 1 1\nTEMP   0   1 2.0E+1 0 0\n"
    changes = ("MODE SEQ", f"MODE SEQ\n{system}"), ("  CURV -0.1\n", f"  CURV -0.1\n{surface}"), ("MNUM 1 1\n", end)
    imported, plain = read_lens(tmp_path, edit(*changes)), read_lens(tmp_path)
    assert all((a == b).all() for a, b in zip(tensors(imported.lens), tensors(plain.lens), strict=True))


@pytest.mark.parametrize(
    "line", ["  DISZ 1e308", "  PARM 8 1e300", "  PARM 8 1e-290", "  FLAP 0 1e308 0", "YFLN 0 1e308"]
)
def test_numbers_that_leave_the_range_in_mm(tmp_path, line):
    """A length must not become infinite, nor a coefficient zero, when metres become millimetres."""
    keyword = line.split()[0]
    old = {"DISZ": "  DISZ 0.8", "PARM": "  PARM 8 1e-06", "FLAP": "  FLAP 0 1.1 0", "YFLN": "YFLN 0 20"}[keyword]
    text = edit((old, line), ("UNIT MM", "UNIT METER"), ("FTYP 0 0", "FTYP 1 0"))
    if line == "  PARM 8 1e300":
        assert math.isfinite(read_lens(tmp_path, text).lens.alpha[0, 7])
    else:
        assert_refused(tmp_path, text, line)


@pytest.mark.parametrize(
    "changes",
    [
        [("CURV 0.25", "CURV 1e308"), ("CURV -0.1", "CURV 1e308")],
        [("CURV 0.25", "CURV 1e200"), ("DISZ 0.8", "DISZ 1e200")],
        [("CURV 0.25", "CURV 0"), ("CURV -0.1", "CURV 0"), ("  CURV 0.1\n", "  CURV 0\n"), ("PARM 1 0.01", "PARM 1 0")],
    ],
)
def test_a_lens_without_a_finite_stop(tmp_path, changes):
    """Powers that overflow, and a plane-parallel plate with an F-number."""
    line = "FNUM 2.8 0"
    assert_refused(tmp_path, edit(*changes, ("ENPD 1.2", line)), line, "radius of the stop")


def extended_asphere(*lines: str) -> str:
    """The text with an extended asphere of these numbers."""
    numbers = "\n".join(f"  XDAT {line}" for line in lines)
    return edit(("EVENASPH", "XASPHERE"), ("  PARM 1 0.01\n  PARM 2 -0.002\n  PARM 8 1e-06", numbers))


@pytest.mark.parametrize(
    "lines, row, words",
    [
        (["1 -3", "2 1"], 0, ["0 .. 240 terms", "-3"]),
        (["1 241", "2 1"], 0, ["0 .. 240 terms", "241"]),
        (["1", "2 1"], 0, ["2 values"]),
        (["1 2", "2 0", "3 1"], 1, ["positive normalisation radius", "0"]),
        (["1 2", "2 1", "5 0.1"], 2, ["2 terms"]),
        (["2 1", "3 0.1"], 1, ["0 terms"]),
        (["1 240", "2 1000", "242 0.1"], 2, ["float64"]),
        (["1 240", "2 0.001", "242 0.1"], 2, ["float64"]),
    ],
)
def test_terms_of_an_extended_asphere(tmp_path, lines, row, words):
    assert_refused(tmp_path, extended_asphere(*lines), f"  XDAT {lines[row]}", *words)


def test_all_terms_of_an_extended_asphere(tmp_path):
    lens = read_lens(tmp_path, extended_asphere("1 240", "2 1", "242 1e-300")).lens
    assert lens.alpha.shape[1] == 240 and float(lens.alpha[0, 239]) == 1e-300
    assert not read_lens(tmp_path, extended_asphere("1 0")).lens.alpha.any()


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize(
    "encoding, mark",
    [(name, b"") for name in ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32")]
    + [("utf-16-be", codecs.BOM_UTF16_BE), ("latin-1", b"")],
)
def test_encodings_and_line_ends(tmp_path, encoding, mark, newline):
    title = "Ø 30 µm" if encoding == "latin-1" else "Ø 30 µm – 透镜"
    text = edit(("A doublet", title)).replace("\n", newline)
    (tmp_path / "lens.zmx").write_bytes(mark + text.encode(encoding))
    assert zemax.read(tmp_path / "lens.zmx").title == title


@pytest.mark.parametrize(
    "content, words",
    [
        (codecs.BOM_UTF16_LE + LENS_TEXT.encode("utf-16-le")[:301], ["line 10", "UTF-16", "cut off"]),
        (LENS_TEXT.encode("utf-16-le")[:301], ["line 10", "UTF-16", "cut off"]),
        (codecs.BOM_UTF8 + LENS_TEXT.encode() + b"\xff", ["line 55", "UTF-8"]),
        (LENS_TEXT.replace("A doublet", "A\0doublet").encode(), ["line 3", r"'\x00'"]),
        (LENS_TEXT.replace("DISZ 0.8", "DISZ 0\x1b8").encode(), ["line 26", r"'\x1b'"]),
        (codecs.BOM_UTF16_LE + LENS_TEXT.encode("utf-16-le").replace(b"d\0o\0", b"\0\xd8o\0"), ["line 3", "UTF-16"]),
        (b"\x89PNG\r\n\x1a\n\0\0", ["line 2", "text file"]),
        (codecs.BOM_UTF16_LE, ["SURF"]),
    ],
)
def test_damaged_text(tmp_path, content, words):
    (tmp_path / "lens.zmx").write_bytes(content)
    with pytest.raises(FileError) as error:
        zemax.read(tmp_path / "lens.zmx")
    assert all(word in str(error.value) for word in ["lens.zmx", *words]), error.value
