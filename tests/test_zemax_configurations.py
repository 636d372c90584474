"""Configurations of Zemax files: what an operand sets is what a file with this value itself says."""

import pytest
from prescriptions import same_bits
from zemax_texts import LENS_TEXT, edit, read_lens

from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import Prescription
from tasklens.runtime.files import FileError

TAIL = "0 0 0 1 1 1 0 0"  # OpticStudio's words behind a value


def with_rows(*rows: str, saved: int = 1, text: str = LENS_TEXT) -> str:
    """The text with operands, saved in a configuration of two."""
    return text.replace("MNUM 1 1\n", f"MNUM 2 {saved}\n" + "".join(f"{row}\n" for row in rows))


def assert_same(actual: Prescription, expected: Prescription) -> None:
    assert same_bits(actual.lens, expected.lens)
    names = ("title", "comments", "aperture", "fields", "wavelengths_um", "primary", "object_distance_mm")
    assert [getattr(actual, name) for name in names] == [getattr(expected, name) for name in names]


DIAM, PARM = 'DIAM 0.55 0 0 0 1 ""', "  PARM 2 -0.002"
OPERANDS = [  # operand, number, value, further words; and the same as changes of the text
    ("THIC", 2, "0.45", TAIL, ("DISZ 0.3", "DISZ 0.45")),
    ("THIC", 0, "350", TAIL, ("DISZ INFINITY", "DISZ 350")),
    ("THIC", 6, "12.5", TAIL),  # the image
    ("CRVT", 1, "0.26", TAIL, ("CURV 0.25", "CURV 0.26")),
    ("CRVT", 4, "1.2E-001", TAIL, ("CURV 0.1\n", "CURV 0.12\n")),
    ("CONN", 1, "-0.7", TAIL, ("CONI -0.5", "CONI -0.7")),
    ("CONN", 2, "-0.7", TAIL, ("CURV -0.1\n", "CURV -0.1\n  CONI -0.7\n")),
    ("GLSS", 1, "PMMA", TAIL, ("GLAS COC 0 0 1.5 40", "GLAS PMMA")),
    ("GLSS", 2, "PMMA", TAIL, ("DISZ 0.3", "DISZ 0.3\n  GLAS PMMA")),
    ("GLSS", 4, "COC", TAIL, ("GLAS ___BLANK 1 0 1.64 23.3 0.01", "GLAS COC")),
    ("GLSS", 1, "", TAIL, ("  GLAS COC 0 0 1.5 40\n", "")),  # air
    ("MIND", 4, "1.65", TAIL, ("1.64 23.3", "1.65 23.3")),
    ("MABB", 4, "25", TAIL, ("1.64 23.3", "1.64 25")),
    ("MDPG", 4, "0.02", TAIL, ("23.3 0.01", "23.3 0.02")),
    ("MIND", 1, "1.65", TAIL),  # not a model glass
    ("PAR2", 1, "1E-4", TAIL, (PARM, "  PARM 2 1e-4")),
    ("PRAM", 1, "1E-4", "0 2 0 1 1 1 0 0", (PARM, "  PARM 2 1e-4")),
    ("SDIA", 2, "0.7", TAIL, ("DIAM 0.8 1", "DIAM 0.7 1")),
    ("SDIA", 4, "0.9", TAIL, ("FLAP 0 1.1", "FLAP 0 0.9")),
    ("SDIA", 1, "0.7", TAIL),  # automatic
    ("APMX", 2, "0.7", TAIL),  # no clear aperture
    ("APDX", 3, "0.1", TAIL),
    ("APTP", 4, "10", TAIL),
    ("STPS", 0, "4", TAIL, ("  STOP\n", ""), ("SURF 4\n", "SURF 4\n  STOP\n")),
    ("APER", 0, "1.1", TAIL, ("ENPD 1.2", "ENPD 1.1")),
    ("SATP", 0, "1", TAIL, ("ENPD 1.2", "FNUM 1.2 0")),
    ("SATP", 0, "3", TAIL, ("ENPD 1.2", "FLOA")),
    ("SATP", 0, "4", TAIL, ("ENPD 1.2", "FNUM 1.2 1")),
    ("FLTP", 0, "2", TAIL, ("FTYP 0 0", "FTYP 2 0")),
    ("XFIE", 2, "2.5", TAIL, ("XFLN 0 1.5", "XFLN 0 2.5")),
    ("YFIE", 2, "25", TAIL, ("YFLN 0 20", "YFLN 0 25")),
    ("YFIE", 3, "25", TAIL),
    ("WAVE", 3, "0.45", TAIL, ("WAVM 3 0.4861", "WAVM 3 0.45")),
    ("PRWV", 0, "1", TAIL, ("PWAV 2", "PWAV 1")),
    ("APDT", 0, "0", TAIL),
    ("MOFF", 0, "9", TAIL),
    ("LTTL", 0, "title", TAIL),
]
every_operand = pytest.mark.parametrize(
    "operand, number, value, tail, changes",
    [(operand, number, value, tail, changes) for operand, number, value, tail, *changes in OPERANDS],
    ids=lambda value: str(value) if isinstance(value, str | int) else None,
)


@every_operand
def test_an_operand_sets_its_value(tmp_path, operand, number, value, tail, changes):
    """In the configuration in which the file was saved, and in another one."""
    expected = read_lens(tmp_path, edit(*changes))
    rows = [f"{operand} {number} {i} {value} {tail}" for i in (1, 2)]
    for saved in (1, 2):
        actual = read_lens(tmp_path, with_rows(rows[saved - 1], saved=saved))
        assert_same(actual, expected)
        first, *others = [remark for remark in actual.remarks if "configuration" in remark]
        assert first == f"configuration {saved} of 2 (--configuration)"
        assert others == [f"the configuration replaces other values of surfaces or system: {operand}"] * bool(changes)
    read_lens(tmp_path, with_rows(rows[1]))
    other = zemax.read(tmp_path / "lens.zmx", configuration=2)
    assert_same(other, expected)
    assert [remark for remark in other.remarks if "configuration" in remark] == [
        "configuration 2 of 2 (--configuration)"
    ]
    assert_same(zemax.read(tmp_path / "lens.zmx"), read_lens(tmp_path))


@every_operand
def test_an_operand_of_the_same_value_changes_nothing(tmp_path, operand, number, value, tail, changes):
    text = with_rows(f"{operand} {number} 1 {value} {tail}", text=edit(*changes))
    actual, expected = read_lens(tmp_path, text), read_lens(tmp_path, edit(*changes))
    assert_same(actual, expected)
    assert {*actual.remarks} == {"configuration 1 of 2 (--configuration)", *expected.remarks}


def test_operands_of_other_lines(tmp_path):
    """Old lists of fields and wavelengths, fields beyond twelve, extended aspheres, clear apertures, vignetting."""
    old = edit(("XFLN", "XFLD"), ("YFLN", "YFLD"), ("WAVM 1 0.6563 1", "WAVL 0.6563 0.5893 0.4861"))
    rows = ["XFIE 1 1 0.5 0", "YFIE 2 1 10 0", "WAVE 1 1 0.64 0"]
    changed = read_lens(tmp_path, with_rows(*rows, text=old))
    assert changed.fields == ("angle_deg", ((0.5, 0.0), (1.5, 10.0))) and changed.wavelengths_um[0] == 0.64
    heights = " ".join(map(str, range(12)))
    further = "".join(f"FEFD {i + 1} 0 {i} 1 0 0 0 0 0\n" for i in range(14))
    many = edit(
        ("FTYP 0 0 2", "FTYP 0 0 14"), ("XFLN 0 1.5", f"XFLN{12 * ' 0'}"), ("YFLN 0 20\n", f"YFLN {heights}\n{further}")
    )
    _, points = read_lens(tmp_path, with_rows("YFIE 3 1 2.5 0", "XFIE 14 1 7 0", text=many)).fields
    assert points[2] == (0.0, 2.5) and points[13] == (7.0, 13.0) and points[12] == (0.0, 12.0)
    terms = "  XDAT 1 2\n  XDAT 2 2\n  XDAT 3 0\n  XDAT 4 0.5"
    extended = edit(("EVENASPH", "XASPHERE"), ("  PARM 1 0.01\n  PARM 2 -0.002\n  PARM 8 1e-06", terms))
    rows = [f"EDVA 1 1 {value} 0 {number} 0 1 1 1 0 0" for number, value in ((2, 1), (4, 0.25))]
    assert read_lens(tmp_path, with_rows(*rows, text=extended)).lens.alpha[0].tolist() == [0, 0.25]
    clear = edit(("DIAM 0.8 1 0 0 1", "CLAP 0 0.8 0"))
    assert float(read_lens(tmp_path, with_rows("APMX 2 1 0.7 0", text=clear)).lens.semi_diameter[1]) == 0.7
    vignetted = read_lens(tmp_path, with_rows("FVCY 2 1 0.2 0", text=edit(("XFLN 0 1.5", "XFLN 0 1.5\nVCYN 0 0"))))
    weighted = read_lens(tmp_path, with_rows("WLWT 2 1 0.2 0"))
    for remarks, start in ((vignetted.remarks, "vignetting factors"), (weighted.remarks, "weights of wavelengths")):
        assert any(remark.startswith(start) for remark in remarks)


def test_operands_together(tmp_path):
    """The type of the aperture before its value, a glass before its index, the stop before its semi-diameter."""
    rows = ["APER 0 1 2.8", "SATP 0 1 1", "SDIA 4 1 0.4", "STPS 0 1 4", "MIND 4 1 1.9", "GLSS 4 1 COC"]
    changes = (
        ("ENPD 1.2", "FNUM 2.8 0"),
        ("  STOP\n", ""),
        ("SURF 4\n", "SURF 4\n  STOP\n"),
        ("FLAP 0 1.1", "FLAP 0 0.4"),
    )
    changes += (("GLAS ___BLANK 1 0 1.64 23.3 0.01", "GLAS COC"),)
    assert_same(read_lens(tmp_path, with_rows(*rows)), read_lens(tmp_path, edit(*changes)))
    rows = ["SDIA 3 1 0.4", "APER 0 1 7"]  # the value of a floating aperture is the semi-diameter of the stop
    floating = edit(("ENPD 1.2", "FLOA"))
    assert float(read_lens(tmp_path, with_rows(*rows, text=floating)).lens.semi_diameter[2]) == 0.4


REFUSED = [
    ("APMN 2 1 0.1 0", "hole"),
    ("APDX 2 1 0.1 0", "decentred"),
    ("APTP 2 1 4 0", "type 4"),
    ("APTP 4 1 0 0", "type 0"),
    ("APDT 0 1 1 0\nAPDF 0 1 2 0", "apodised"),
    ("SATP 0 1 2 0", "object space"),
    ("SATP 0 1 9 0", "0 .. 5"),
    ("APER 0 1 0 0", "positive"),
    ("FLTP 0 1 4 0", "type 0 .. 3"),
    ("PRWV 0 1 5 0", "wavelengths"),
    ("WAVE 1 1 -1 0", "positive wavelengths"),
    ("STPS 0 1 6 0", "1 .. 5"),
    ("GLSS 1 1 MIRROR 0", "mirrors"),
    ("GLSS 1 1 UNOBTAINIUM 0", "--catalogue"),
    ("GLSS 0 1 COC 0", "object is not in air"),
    ("CRVT 6 1 0.1 0", "image surface is curved"),
    ("THIC 0 1 -5 0", "positive distance"),
    ("CRVT 1 1 x 0", "number"),
    ("PAR2 2 1 0.1 0", "no term number 2"),
    ("PRAM 1 1 0.1", "5 values"),
    ("IGNM 2 1 1 0", "ignored"),
    ("TELE 0 1 1 0", "telecentric"),
    ("AFOC 0 1 1 0", "afocal"),
    ("TEMP 0 1 60 0", "20 deg C"),
    ("PRES 0 1 0 0", "1 atm"),
    *((f"{side}{name} 2 1 0.1 0", "tilted") for side in ("CA", "CB") for name in ("DX", "DY", "TX", "TY", "TZ")),
    ("CROR 2 1 1 0", "tilted"),
]


@pytest.mark.parametrize("rows, word", REFUSED)
def test_an_operand_that_sets_what_is_not_supported_is_refused(tmp_path, rows, word):
    text = with_rows(rows, saved=2, text=edit(("DIAM 0.8 1 0 0 1", "CLAP 0 0.8 0")))
    read_lens(tmp_path, text)  # it is not that of the saved configuration
    with pytest.raises(FileError, match=word) as error:
        zemax.read(tmp_path / "lens.zmx", configuration=1)
    assert "lens.zmx" in str(error.value)


SOLVES = [
    ("  DISZ 0.8", "  MAZH 0 0\n  DISZ 0.8"),
    ("  DISZ 0.8", "  PZUP 1 1 0\n  DISZ 0.8"),
    ("CURV 0.25 0", "CURV 0.25 4"),
]


@pytest.mark.parametrize("solve", SOLVES, ids=lambda solve: solve[1].split("\n")[0].strip())
def test_solves_have_the_values_of_the_file_as_saved(tmp_path, solve):
    """Apertures and fields of the saved configuration may have changed since; whatever moves paraxial rays may not."""
    text = edit(solve)
    message = "a solve, whose value in the file need not be that of configuration"
    for row in ("THIC 2 {} 0.45 0", "GLSS 1 {} PMMA 0", "WAVE 1 {} 0.64 0", "STPS 0 {} 4 0", "PRWV 0 {} 1 0"):
        for saved in (1, 2):
            (tmp_path / "lens.zmx").write_text(with_rows(row.format(1), saved=saved, text=text))
            with pytest.raises(FileError, match=f"{message} 1"):
                zemax.read(tmp_path / "lens.zmx", configuration=1)
    for row in ("SDIA 2 {} 0.7 0", "APER 0 {} 1.1 0", "YFIE 2 {} 25 0"):
        read_lens(tmp_path, with_rows(row.format(1), text=text))
        with pytest.raises(FileError, match=f"{message} 2"):
            read_lens(tmp_path, with_rows(row.format(2), text=text))
            zemax.read(tmp_path / "lens.zmx", configuration=2)
    read_lens(
        tmp_path, with_rows("THIC 6 2 9 0", "WLWT 2 2 3 0", "SDIA 1 2 5 0", "TSP1 1 1 2 0", "TSP1 1 2 2 0", text=text)
    )
    zemax.read(tmp_path / "lens.zmx", configuration=2)
    read_lens(tmp_path, with_rows("TSP1 1 1 0 0", "TSP1 1 2 1 0", text=text))
    with pytest.raises(FileError, match=message):
        zemax.read(tmp_path / "lens.zmx", configuration=2)


@pytest.mark.parametrize("number", [0, 3])
def test_a_configuration_that_the_file_lacks(tmp_path, number):
    (tmp_path / "lens.zmx").write_text(with_rows("THIC 2 1 0.3 0"))
    with pytest.raises(FileError, match=rf"expected a configuration 1 \.\. 2, got {number} \(--configuration\)"):
        zemax.read(tmp_path / "lens.zmx", configuration=number)
