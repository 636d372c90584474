"""Glasses by name: catalogues of makers and users, which of them defines a name, and the names in a Zemax file."""

import re
from pathlib import Path

import pytest
import yaml
from examples import load_script, make_lens
from zemax_texts import CATALOGUE_TEXT

from tasklens.materials import catalogues, library
from tasklens.materials.catalogues import builtin
from tasklens.materials.library import FOLDER, Library, UnknownGlassError, in_zemax, nearest, of_maker, user_files
from tasklens.materials.material import C_LINE, D_LINE, F_LINE, Material
from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import Prescription
from tasklens.runtime.files import FileError

MAKERS = ("SCHOTT", "OHARA", "HOYA", "HIKARI", "CDGM", "SUMITA")

# nd and Vd in the makers' data sheets, of current and obsolete glasses
DATA_SHEETS = [
    ("SCHOTT", "N-BK7", 1.51680, 64.17),
    ("SCHOTT", "BK7", 1.51680, 64.17),
    ("SCHOTT", "SF6", 1.80518, 25.43),
    ("SCHOTT", "SK16", 1.62041, 60.33),
    ("SCHOTT", "LAK9", 1.69100, 54.71),
    ("SCHOTT", "B270", 1.52308, 58.57),
    ("OHARA", "S-BSL7", 1.51633, 64.14),
    ("OHARA", "S-TIH53", 1.84666, 23.78),
    ("HOYA", "FCD1", 1.49700, 81.61),
    ("HIKARI", "J-LASF05", 1.83481, 42.72),
    ("CDGM", "H-K9L", 1.51680, 64.20),
    ("SUMITA", "K-BK7", 1.51633, 64.06),
]


@pytest.mark.parametrize("maker, name, nd, vd", DATA_SHEETS)
def test_nd_and_vd_of_data_sheets(maker, name, nd, vd):
    actual_nd, actual_vd = of_maker(maker)[name].abbe()
    assert actual_nd == pytest.approx(nd, abs=1.5e-5) and actual_vd == pytest.approx(vd, abs=2e-2)


def test_every_glass_of_the_makers_is_a_glass():
    """The number of glasses, indices above 1 in range and falling in the visible, plausible nd and Vd."""
    assert {maker: len(of_maker(maker)) for maker in MAKERS} == {
        "SCHOTT": 359, "OHARA": 417, "HOYA": 408, "HIKARI": 379, "CDGM": 314, "SUMITA": 192,
    }  # fmt: skip
    for maker in MAKERS:
        for glass in of_maker(maker).values():
            assert glass.zemax == f"{maker} {glass.name}" and glass.name == glass.name.upper()
            lines = [glass.refractive_index(w) for w in (F_LINE, D_LINE, C_LINE) if glass.covers(w)]
            assert lines == sorted(lines, reverse=True) and all(1.35 < n < 2.3 for n in lines)


def test_the_catalogues_come_from_the_database():
    """From refractiveindex.info, as in Optiland, the tool generates the packaged data, here of two makers."""
    optiland = pytest.importorskip("optiland")
    tool = load_script(Path(__file__).parents[1] / "tools" / "glass_catalogues.py")
    database = Path(optiland.__file__).parent / "database" / "data-nk" / "glass"
    for maker in ("OHARA", "SUMITA"):
        _, glasses = tool.catalogue(maker, database, [])
        assert len(glasses) > 150
        for glass in glasses:
            packaged = of_maker(maker)[glass.name]
            assert packaged.formula == glass.formula
            assert packaged.coefficients == pytest.approx(glass.coefficients, rel=1e-11)


# ---- name lookup


def write_catalogue(folder: Path, name: str, *glasses: tuple[str, float]) -> Path:
    path = folder / f"{name}.agf"
    path.write_text("".join(f"NM {glass} 5 0 1.5 50\nCD {index} 0 0\nLD 0.4 0.8\n" for glass, index in glasses))
    return path


def test_the_order_of_search(tmp_path):
    """Catalogues listed by the lens, in its order; then the user's, plastics, makers."""
    catalogue = write_catalogue(tmp_path, "mine", ("F2", 1.4), ("COC", 1.6))
    assert Library().glass("COC") == builtin("COC") and Library([catalogue]).glass("COC").source == "mine.agf"
    assert Library().glass("F2") == of_maker("SCHOTT")["F2"]
    assert Library([], ["HIKARI"]).glass("F2") == of_maker("HIKARI")["F2"] != of_maker("SCHOTT")["F2"]
    assert Library([], ["NIKON"]).glass("F2") == of_maker("HIKARI")["F2"]
    assert Library([catalogue]).glass("F2").source == "mine.agf"
    assert Library([catalogue], ["SCHOTT"]).glass("F2") == of_maker("SCHOTT")["F2"]
    assert Library([catalogue], ["MINE", "SCHOTT"]).glass("F2").source == "mine.agf"
    assert Library([], ["MISC"]).glass("POLYSTYR") == builtin("PS") and "POLYCARB" in in_zemax("MISC")


def test_a_choice_between_makers_is_a_remark():
    """Unless the lens lists the catalogue, or the others have the same glass."""
    search = Library()
    search.glass("F2")
    assert search.remarks == ["glass F2 taken from SCHOTT; other makers: HOYA, HIKARI, CDGM (--catalogue)"]
    for listed, name in ((["SCHOTT"], "F2"), (["NIKON"], "F2"), ([], "N-BK7")):
        search = Library([], listed)
        search.glass(name)
        assert search.remarks == []


def test_built_in_plastics_need_no_catalogue_of_a_maker(monkeypatch):
    """Every job parses the study, and most studies use only plastics."""
    monkeypatch.setattr(library, "of_maker", lambda maker: pytest.fail(f"{maker} was read"))
    assert Library().glass("COC") == builtin("COC")


def test_an_unknown_glass_is_refused_with_the_nearest_names(tmp_path):
    with pytest.raises(UnknownGlassError, match=r"'N-BK77' in mine\.agf.*nearest names: N-BK7"):
        Library([write_catalogue(tmp_path, "mine", ("A", 1.5))]).glass("N-BK77")


def test_one_glass_without_data_does_not_spoil_its_catalogue(tmp_path):
    path = write_catalogue(tmp_path, "maker", ("GOOD", 1.5))
    path.write_text(path.read_text() + "NM UNMEASURED 2 0 1.5 60\nCD 1 0.006 0.2 0.02 1 103\nLD 0 0\n")
    assert Library([path]).glass("GOOD").refractive_index(0.5) == 1.5
    with pytest.raises(FileError, match=r"maker\.agf, line 6: LD: UNMEASURED: expected a range"):
        Library([path]).glass("UNMEASURED")


def test_a_folder_of_ones_own_catalogues(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    catalogue = write_catalogue(tmp_path, "mine", ("A", 1.5))
    (tmp_path / "notes.txt").write_text("")
    assert user_files() == [catalogue]
    monkeypatch.setenv(FOLDER, str(tmp_path / "absent"))
    with pytest.raises(FileError, match=rf"absent: no such folder.*{FOLDER}"):
        user_files()


def test_the_nearest_glass():
    """Data-sheet values within rounding; any of the five glasses equal to BK7 will do."""
    for nd, vd in ((1.5168, 64.2), (1.80518, 25.43), (1.6910, 54.7)):
        assert nearest(nd, vd).abbe() == pytest.approx((nd, vd), abs=0.05)


# ---- names in a Zemax file


def with_glasses(*glasses: Material) -> Prescription:
    media = [medium for glass in glasses for medium in (glass, "air")]
    lens = make_lens([0.1, -0.1] * len(glasses), [0.5] * len(media), media, semi_diameter=[1.0] * len(media))
    return Prescription(lens, fields=("angle_deg", ((0.0, 10.0),)), wavelengths_um=(0.5876,), primary=0)


def round_trip(tmp_path: Path, *glasses: Material, files: list[Path] | None = None) -> tuple[list[Material], str]:
    """Glasses of a lens after writing and reading, and the catalogues listed in its file."""
    zemax.write(tmp_path / "out.zmx", with_glasses(*glasses))
    text = (tmp_path / "out.zmx").read_text()
    reread = zemax.read(tmp_path / "out.zmx", files or [])
    return list(reread.lens.media[::2]), re.search("GCAT (.*)", text)[1]


def indices(glasses: list[Material]) -> list[float]:
    return [glass.refractive_index(D_LINE) for glass in glasses]


def test_two_makers_of_one_name(tmp_path):
    """LAF20 of Schott and TAF3 of Hoya, which also has a LAF20: Schott is listed first."""
    glasses = [of_maker("HOYA")["TAF3"], of_maker("SCHOTT")["LAF20"]]
    assert of_maker("HOYA")["LAF20"].abbe()[0] != pytest.approx(glasses[1].abbe()[0], abs=0.01)
    reread, listed = round_trip(tmp_path, *glasses)
    assert indices(reread) == indices(glasses) and listed == "SCHOTT HOYA"
    assert not (tmp_path / "out.agf").exists()


def test_glasses_whose_order_cannot_be_right_go_into_a_catalogue_of_the_lens(tmp_path):
    """F2 of both makers: one of them gets another name."""
    glasses = [of_maker("HIKARI")["F2"], of_maker("SCHOTT")["F2"], of_maker("SCHOTT")["N-BK7"]]
    reread, listed = round_trip(tmp_path, *glasses)
    assert indices(reread) == indices(glasses) and listed.startswith("OUT ")
    assert len({glass.name for glass in reread}) == 3


def test_a_glass_behind_a_catalogue_of_unknown_contents(tmp_path):
    """Two catalogues of the user: in OpticStudio both may contain the name."""
    first, second = write_catalogue(tmp_path, "first", ("A", 1.5)), write_catalogue(tmp_path, "second", ("B", 1.6))
    glasses = [catalogues.read(first)["A"], catalogues.read(second)["B"]]
    reread, listed = round_trip(tmp_path, *glasses, files=[second, first])
    assert indices(reread) == indices(glasses) and listed == "OUT first"


@pytest.mark.parametrize("encoding", ["ascii", "utf-8-sig", "utf-16", "utf-16-be", "latin-1"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_a_catalogue_is_read_in_every_encoding(tmp_path, encoding, newline):
    text = CATALOGUE_TEXT if encoding == "ascii" else CATALOGUE_TEXT.replace("a catalogue", "Gläser")
    bom = b"\xfe\xff" if encoding == "utf-16-be" else b""
    (tmp_path / "mine.AGF").write_bytes(bom + text.replace("\n", newline).encode(encoding))
    materials = catalogues.read(tmp_path / "mine.AGF")
    assert materials == {
        "CROWN": Material("CROWN", "schott", (2.29, -0.0102, 0.0134, 2e-4, 0, 0), (0.4, 0.8), "mine.AGF", "mine CROWN"),
        "FLINT": Material("FLINT", "conrady", (1.5, 0.01, 0.002), (0.35, 0.9), "mine.AGF", "mine FLINT"),
    }


def test_the_first_file_that_has_a_name_defines_it(tmp_path):
    """Its definition precedes built-in materials; other names stay as they are."""
    definition = builtin("PMMA").definition()
    for name, index in (("a", 1.4), ("b", 1.6)):
        entry = definition | {"formula": "conrady", "coefficients": [index, 0, 0]}
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump({"COC": entry, name: entry}))
    library = Library([tmp_path / "a.yaml", tmp_path / "b.yaml"])
    assert library.glass("COC").refractive_index(0.5) == 1.4 and library.glass("b").refractive_index(0.5) == 1.6
    assert library.glass("OKP4") == builtin("OKP4")


@pytest.mark.parametrize("code, nd", [("517642", 1.517), ("003283", 2.003), ("102168", 2.102), ("434950", 1.434)])
def test_a_glass_code(code, nd):
    """S-LAH79 is 003283 and L-BBH1 102168; no glass has an index of 1.1 or less."""
    assert float(Library().glass(code).refractive_index(0.58756)) == pytest.approx(nd, abs=1e-6)
