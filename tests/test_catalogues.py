"""Files of materials: Zemax's catalogues in every encoding, our YAML, and which file defines a name."""

import pytest
import yaml
from zemax_texts import CATALOGUE_TEXT, whole_catalogue

from tasklens.materials import catalogues
from tasklens.materials.catalogues import builtin
from tasklens.materials.library import Library
from tasklens.materials.material import Material
from tasklens.runtime.files import FileError


@pytest.mark.parametrize("encoding", ["ascii", "utf-8-sig", "utf-16", "utf-16-be", "latin-1"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_a_catalogue_is_read_in_every_encoding(tmp_path, encoding, newline):
    text = CATALOGUE_TEXT.replace("a catalogue", "a catalogue" if encoding == "ascii" else "Gläser").replace(
        "\n", newline
    )
    bom = b"\xfe\xff" if encoding == "utf-16-be" else b""
    (tmp_path / "mine.AGF").write_bytes(bom + text.encode(encoding))
    materials = catalogues.read(tmp_path / "mine.AGF")
    assert materials == {
        "CROWN": Material("CROWN", "schott", (2.29, -0.0102, 0.0134, 2e-4, 0, 0), (0.4, 0.8), "mine.AGF", "mine CROWN"),
        "FLINT": Material("FLINT", "conrady", (1.5, 0.01, 0.002), (0.35, 0.9), "mine.AGF", "mine FLINT"),
    }


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("CD 1.5 0.01", "CD 1.5 0.0.1", ["line 8", "CD", "0.0.1"]),
        ("CD 1.5 0.01", "CD 1.5 nan", ["line 8", "nan"]),
        ("LD 0.4 0.8", "LD 0.8 0.4", ["line 6", "CROWN", "rising"]),
        ("LD 0.4 0.8", "LD 0.4", ["line 6", "2 values"]),
        ("LD 0.4 0.8\n", "", ["line 2", "CROWN", "LD"]),
        ("NM FLINT 5", "NM FLINT 14", ["line 7", "1 .. 13", "14"]),
        ("NM CROWN 1 517642", "NM CROWN", ["line 2", "expected"]),
        ("NM CROWN", "XX CROWN", ["line 4", "NM"]),
    ],
)
def test_a_broken_glass_is_refused_with_its_line(tmp_path, old, new, words):
    """Only if it is used; the other glass is read. Bad lines in front of the first glass refuse the file."""
    assert old in CATALOGUE_TEXT
    (tmp_path / "mine.agf").write_text(CATALOGUE_TEXT.replace(old, new))
    with pytest.raises(FileError) as error:
        whole_catalogue(tmp_path / "mine.agf")
    assert all(word in str(error.value) for word in ["mine.agf", *words]), error.value


@pytest.mark.parametrize(
    "name, content",
    [("a.agf", b"hello\n"), ("b.agf", b"\0\1\2"), ("c.txt", b""), ("d.yaml", b"a: [1"), ("e.yaml", b"3")],
)
def test_what_is_no_file_of_materials_is_refused(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError, match=name):
        catalogues.read(tmp_path / name)


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
