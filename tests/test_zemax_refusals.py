"""Lines of a Zemax file that change rays are read, or refused by line: flags, apertures, environment, numbers."""

import codecs
import math

import pytest
from prescriptions import tensors
from zemax_texts import LENS_TEXT, edit, read_lens

from tasklens.optics.io import zemax
from tasklens.runtime.files import FileError

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
