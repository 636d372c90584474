"""Property-based fuzzing of all files that a user writes: each is accepted, or refused with an error that names it.

The profile is fixed, so that every run has the same examples. To search for longer, with other examples each time:

    TASKLENS_FUZZ=100 pytest tests/test_fuzz.py -n 0

runs a hundred times as many. Add failures to bad_inputs.yaml.
"""

import copy
import io
import math
import os
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
import yaml
from examples import tiny_study
from hypothesis import HealthCheck, Phase, event, given, settings
from hypothesis import strategies as st
from PIL import Image
from prescriptions import random_prescription, same_bits
from zemax_texts import CATALOGUE_TEXT, LENS_TEXT

from tasklens.materials import catalogues
from tasklens.optics.io import prescription, zemax
from tasklens.recognition import folders
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError
from tasklens.study import loading
from tasklens.study.study import StudyError

resource = pytest.importorskip("resource")  # not on Windows

TIMES = int(os.environ.get("TASKLENS_FUZZ", "0"))
SECONDS, BYTES = 5.0, 2**28  # limits on computing time and new memory, for one file
MOST_POINTS = 4  # points of a sweep that are parsed


def examples(count: int) -> settings:
    return settings(
        max_examples=count * (TIMES or 1),
        derandomize=not TIMES,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.explicit, Phase.generate, *([Phase.shrink] if TIMES else [])],  # shrinking takes minutes
    )


# ---- writing


class Plain(str):
    """Characters that stand in a YAML file without quotes."""


class Dumper(yaml.SafeDumper):
    pass


def represent_plain(dumper: Dumper, value: Plain) -> yaml.Node:
    return dumper.represent_scalar(dumper.resolve(yaml.ScalarNode, value, (True, False)), str(value))


Dumper.add_representer(Plain, represent_plain)
Dumper.add_representer(tuple, Dumper.represent_list)


def dump_yaml(content) -> str:
    return yaml.dump(content, Dumper=Dumper, sort_keys=False, allow_unicode=True)


PLAIN = [
    *("0x10", "0b101", "1_000", "1e3", "1e999", "-1e-999", "-.inf", "-0.0", "+1", "1.", "~", "=", "<<"),
    *("yes", "Off", "null", "2026-01-01T00:00:00Z"),
]
HOSTILE = ["0x" + "f" * 5000, ".nan", ".inf", "2026-01-01", "1" * 400]
NUMBERS = st.one_of(
    st.integers(-3, 70),
    st.integers(),
    st.sampled_from([2**31, 2**63 - 1, 2**63, -(2**63), 2**64, 10**18, 10**400, 1e308, 5e-324, math.inf, math.nan]),
    st.floats(),
    st.floats(0, 3),
)
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)


def values(words: list[str], leaves: int = 5) -> st.SearchStrategy:
    """Any value that a YAML file can hold, often with words of the file itself."""
    scalars = st.one_of(
        NUMBERS,
        st.sampled_from(words),
        st.booleans() | st.none(),
        TEXTS | st.text("0123456789.eE+-_x ", max_size=8),
        st.sampled_from(PLAIN).map(Plain),
        st.sampled_from(HOSTILE).map(Plain),
        st.dates() | st.datetimes() | st.binary(max_size=6) | st.sets(TEXTS, max_size=2),
    )
    keys = st.sampled_from(words) | TEXTS | st.integers(0, 9) | st.booleans() | st.floats(allow_nan=False) | st.none()
    return st.recursive(
        scalars,
        lambda inner: (
            st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=3) | st.tuples(NUMBERS, NUMBERS)
        ),
        max_leaves=leaves,
    )


def places(content, above: tuple = ()) -> Iterator[tuple]:
    """Keys and indices of all values of nested mappings and lists."""
    pairs = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in pairs:
        yield (*above, key)
        yield from places(value, (*above, key))


def words_of(content) -> list[str]:
    leaves = [place[-1] for place in places(content)]
    words = {word for word in leaves if isinstance(word, str)}
    return sorted(words | {word for word in scalars_of(content) if isinstance(word, str)})


def scalars_of(content) -> Iterator:
    if isinstance(content, dict | list):
        for inner in content.values() if isinstance(content, dict) else content:
            yield from scalars_of(inner)
    else:
        yield content


@st.composite
def changed_content(draw, content) -> object:
    """The content with one to three values replaced, added, removed, doubled, or moved to another key."""
    words = words_of(content)
    content = copy.deepcopy(content)
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        paths = list(places(content))
        if not paths:
            return content
        section = draw(st.sampled_from(list(content)))  # short sections as often as long ones
        *above, key = draw(st.sampled_from([place for place in paths if place[0] == section]))
        inside = content
        for step in above:
            inside = inside[step]
        action = draw(st.sampled_from(["near", "near", "value", "value", "value", "add", "remove", "copy", "rename"]))
        if action == "near":  # of the same kind, so that some are accepted
            inside[key] = draw(near(inside[key], words))
        elif action == "value":
            inside[key] = draw(values(words))
        elif action == "remove":
            del inside[key]
        elif action == "copy":
            node = content
            for step in draw(st.sampled_from(paths)):
                node = node[step]
            inside[key] = copy.deepcopy(node)
        elif isinstance(inside, list):
            inside.insert(key, draw(values(words)))
        elif action == "rename":
            inside[draw(st.sampled_from(words) | TEXTS)] = inside.pop(key)
        else:
            inside[draw(st.sampled_from(words) | TEXTS)] = draw(values(words))
    return content


def near(value, words: list[str]) -> st.SearchStrategy:
    if isinstance(value, bool):
        return st.booleans()
    if isinstance(value, int):
        return st.integers(0, 2 * abs(value) + 2)
    if isinstance(value, float):
        return st.sampled_from([0.5, 0.9, 1.1, 2.0, -1.0]).map(lambda factor: factor * value)
    if isinstance(value, list) and value:
        return st.permutations(value) | st.just([*value, value[0]]) | st.just(value[1:])
    return st.sampled_from(words)


def damaged_bytes(content: bytes, inserted: list[bytes]) -> st.SearchStrategy[bytes]:
    """The bytes with a few of them flipped, cut off, repeated, moved, or others inserted."""

    @st.composite
    def strategy(draw) -> bytes:
        data = content
        for _ in range(draw(st.integers(1, 3))):
            first, last = sorted(draw(st.tuples(*2 * [st.integers(0, len(data))])))
            match draw(st.sampled_from(["flip", "flip", "cut", "remove", "repeat", "insert", "insert", "overwrite"])):
                case "flip" if first < len(data):
                    data = data[:first] + bytes([data[first] ^ (1 << draw(st.integers(0, 7)))]) + data[first + 1 :]
                case "cut":
                    data = data[:first]
                case "remove":
                    data = data[:first] + data[last:]
                case "repeat":
                    data = data[:last] + data[first:last] + data[last:]
                case "insert":
                    data = data[:first] + draw(st.sampled_from(inserted) | st.binary(max_size=8)) + data[first:]
                case "overwrite":
                    new = draw(st.sampled_from(inserted) | st.binary(max_size=8))
                    data = data[:first] + new + data[first + len(new) :]
        return data

    return strategy()


def altered_text(text: str, inserted: list[str]) -> st.SearchStrategy[str]:
    """The text with words replaced, and lines removed, repeated, exchanged or indented."""

    @st.composite
    def strategy(draw) -> str:
        lines = text.split("\n")
        for _ in range(draw(st.integers(1, 3))):
            row = draw(st.integers(0, len(lines) - 1))
            match draw(
                st.sampled_from(["word", "word", "word", "word", "insert", "remove", "repeat", "exchange", "indent"])
            ):
                case "word":
                    words = lines[row].split(" ")
                    new = st.sampled_from(inserted) | NUMBERS.map(str) | TEXTS
                    words[draw(st.integers(0, len(words) - 1))] = draw(new)
                    lines[row] = " ".join(words)
                case "insert":
                    line = st.lists(st.sampled_from(inserted) | NUMBERS.map(str), max_size=5).map(" ".join)
                    lines.insert(row, draw(st.sampled_from(["", "  "])) + draw(line))
                case "remove" if len(lines) > 1:
                    del lines[row]
                case "repeat":
                    lines.insert(row, draw(st.sampled_from(lines)))
                case "exchange":
                    other = draw(st.integers(0, len(lines) - 1))
                    lines[row], lines[other] = lines[other], lines[row]
                case "indent":
                    lines[row] = lines[row].strip() if lines[row].startswith(" ") else f"  {lines[row]}"
        return "\n".join(lines)

    return strategy()


# ---- reading


@contextmanager
def bounded() -> Iterator[None]:
    """Bound the computing time and the additional memory of a block."""
    limits, begun = resource.getrlimit(resource.RLIMIT_AS), time.process_time()
    statm = Path("/proc/self/statm")
    if statm.exists():
        memory = int(statm.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (memory + BYTES, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert time.process_time() - begun < SECONDS


def read_or_refuse(path: Path, content: bytes | str, read: Callable, error: type[InputError] = FileError):
    """Return the result of `read`, or None if it refuses the file with the right kind of error that names it."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
    try:
        with bounded():
            result = read(path)
    except error as refusal:
        message = str(refusal)
        assert type(refusal) is error
        assert path.name in message
        event("refused")
        return None
    event("accepted")
    return result


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


# ---- studies


def whole_study() -> dict:
    """The tiny study with all defaults written out, and with an ablation, other specifications, and a sweep."""
    study = tiny_study() | {
        "specs": {"singlet": {"f_number": 3.0}},
        "ablations": {"rays": {"elements": "singlet", "design": "tasklens", "variants": {"few": {"rays": 8}}}},
        "sweep": {"spec.f_number": [2.8, 4.0]},
        "restored": ["singlet"],
    }
    return loading.resolved(loading.parse(study))


STUDY = whole_study()


def check_study(path: Path, content: str) -> None:
    study = read_or_refuse(path, content, loading.load, StudyError)
    if study is None:
        return
    path.write_text(loading.dump(study), encoding="utf-8")
    assert loading.load(path) == study
    if math.prod(map(len, study.sweep.values())) <= MOST_POINTS:
        try:
            points = loading.at_points(study)
        except StudyError as error:
            assert "sweep" in str(error)
        else:
            assert [loading.parse(loading.resolved(point)) for point in points] == points


@pytest.mark.slow
@examples(450)
@given(changed_content(STUDY))
def test_a_study_is_read_or_refused(folder, content):
    check_study(folder / "study.yaml", dump_yaml(content))


YAML_WORDS = [
    "- ",
    "? ",
    ": ",
    "{",
    "}",
    "[",
    "]",
    "&a",
    "*a",
    "<<",
    "!!",
    "!!set",
    "|",
    ">-",
    "%YAML 9.9",
    "---",
    "...",
]
YAML_WORDS += ["#", '"', "'", "\t", "\r", "\x85", "\u2028", "\ufeff", "\0", *PLAIN, *HOSTILE]


@examples(250)
@given(
    altered_text(dump_yaml(tiny_study()), YAML_WORDS)
    | st.text(max_size=60)
    | st.lists(st.sampled_from(YAML_WORDS)).map("".join)
)
def test_the_text_of_a_study_is_read_or_refused(folder, text):
    check_study(folder / "study.yaml", text.encode("utf-8", "surrogatepass").decode("utf-8", "replace"))


# ---- lenses and materials

LENS = prescription.to_dict(random_prescription(6))


def same_prescription(a: prescription.Prescription, b: prescription.Prescription) -> bool:
    fields = [{key: value for key, value in vars(entry).items() if key != "lens"} for entry in (a, b)]
    return same_bits(a.lens, b.lens) and fields[0] == fields[1]


def check_yaml_lens(path: Path, lens: prescription.Prescription) -> None:
    """An accepted lens survives writing and reading; two materials may not share a name."""
    try:
        prescription.write(path, lens, {})
    except FileError as error:
        assert "rename one" in str(error)
    else:
        assert same_prescription(prescription.read(path)[0], lens)


@examples(350)
@given(changed_content(LENS))
def test_a_lens_file_is_read_or_refused(folder, content):
    result = read_or_refuse(folder / "lens.yaml", dump_yaml(content), prescription.read)
    if result is not None:
        check_yaml_lens(folder / "again.yaml", result[0])


ZEMAX_WORDS = sorted({word for line in LENS_TEXT.split("\n") for word in line.split()})
ZEMAX_WORDS += [
    "XASPHERE",
    "XDAT",
    "EVENASPH",
    "INFINITY",
    "FNUM",
    "FLOA",
    "CLAP",
    "WAVL",
    "IN",
    "METER",
    "MIRROR",
    "\0",
]


def check_zemax(path: Path, content: bytes | str) -> None:
    lens = read_or_refuse(path, content, zemax.read)
    if lens is None:
        return
    copy_path = path.with_name("again.zmx")
    copy_path.with_suffix(".agf").unlink(missing_ok=True)
    try:
        zemax.write(copy_path, lens)
    except InputError as error:
        event(f"not written: {str(error).split(':')[1:2]}")
    else:
        assert same_bits(zemax.read(copy_path).lens, lens.lens)
    check_yaml_lens(path.with_name("again.yaml"), lens)


@examples(350)
@given(altered_text(LENS_TEXT, ZEMAX_WORDS))
def test_a_zemax_file_is_read_or_refused(folder, text):
    check_zemax(folder / "lens.zmx", text)


@examples(150)
@given(damaged_bytes(LENS_TEXT.encode("utf-16"), [b"\xff\xfe", b"\xef\xbb\xbf", b"\0", b"\n\0", b"\r", b"\xd8\0"]))
def test_the_bytes_of_a_zemax_file_are_read_or_refused(folder, content):
    check_zemax(folder / "lens.zmx", content)


AGF_WORDS = ["NM", "CD", "LD", "GC", "ED", "TD", "OD", "MIRROR", "___BLANK", "air", "13", "1e-320", "INFINITY"]


def check_agf(path: Path, content: bytes | str) -> None:
    catalogue = read_or_refuse(path, content, catalogues.read)
    if catalogue is None:
        return
    copy_path = path.with_name("again.agf")
    try:
        catalogues.write_agf(copy_path, catalogue.values())
    except InputError as error:
        assert any(name in str(error) for name in catalogue)
    else:
        numbers = [
            {name: (material.formula, material.coefficients, material.range_um) for name, material in materials.items()}
            for materials in (catalogues.read(copy_path), catalogue)
        ]
        assert numbers[0] == numbers[1]


@examples(300)
@given(altered_text(CATALOGUE_TEXT, AGF_WORDS) | st.text(max_size=40))
def test_a_catalogue_is_read_or_refused(folder, text):
    check_agf(folder / "maker.agf", text.encode("utf-8", "surrogatepass").decode("utf-8", "replace"))


@examples(150)
@given(damaged_bytes(CATALOGUE_TEXT.encode(), [b"\xff\xfe", b"\xef\xbb\xbf", b"\0", b"\xe9", b"NM "]))
def test_the_bytes_of_a_catalogue_are_read_or_refused(folder, content):
    check_agf(folder / "maker.agf", content)


PLASTICS = yaml.safe_load(catalogues.PLASTICS.read_text(encoding="utf-8"))


@examples(150)
@given(changed_content(PLASTICS))
def test_materials_are_read_or_refused(folder, content):
    path = folder / "materials.yaml"
    materials = read_or_refuse(path, dump_yaml(content), catalogues.read)
    if materials is not None:
        path.write_text(
            dump_yaml({name: material.definition() for name, material in materials.items()}), encoding="utf-8"
        )
        assert catalogues.read(path) == materials


# ---- images


def image_bytes(kind: str, mode: str) -> bytes:
    image = Image.effect_noise((12, 8), 60).convert(mode)
    exif = Image.Exif()
    exif[0x0112] = 6  # turned
    file = io.BytesIO()
    image.save(file, kind, exif=exif)
    return file.getvalue()


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")


@st.composite
def png_files(draw) -> bytes:
    """A PNG file with well-formed chunks of arbitrary content and arbitrary header values."""
    sizes = st.sampled_from([0, 1, 8, 12, 3000, 30000, 65535, 2**31 - 1, 2**32 - 1])
    header = b"".join(draw(sizes).to_bytes(4, "big") for _ in range(2))
    header += bytes([draw(st.sampled_from([1, 2, 4, 8, 16, 3])), draw(st.sampled_from([0, 2, 3, 4, 6, 5])), 0, 0])
    header += bytes([draw(st.integers(0, 1))])
    kinds = [b"PLTE", b"tRNS", b"gAMA", b"iCCP", b"eXIf", b"zTXt", b"iTXt", b"tEXt", b"acTL", b"fcTL", b"pHYs", b"xxxX"]
    others = st.lists(st.builds(png_chunk, st.sampled_from(kinds), st.binary(max_size=30)), max_size=3)
    pixels = png_chunk(b"IDAT", zlib.compress(bytes(draw(st.integers(0, 400)))))
    return b"\x89PNG\r\n\x1a\n" + b"".join([png_chunk(b"IHDR", header), *draw(others), pixels, png_chunk(b"IEND", b"")])


JPEG_PARTS = [
    b"\xff\xd8",
    b"\xff\xd9",
    b"\xff\xc0\x00\x11\x08\xff\xff\xff\xff",
    b"\xff\xe1\x00\x08Exif\0\0",
    b"\xff\xda",
]
JPEG_PARTS += [
    b"\xff\xdb\x00\x02",
    b"\xff\xc4\x00\x02",
    b"\xff\xe2\x00\x10ICC_PROFILE\0\x01\x02",
    b"\xff\xee\x00\x0eAdobe",
]
IMAGES = [
    damaged_bytes(image_bytes(kind, mode), parts)
    for kind, mode, parts in [
        ("PNG", "RGB", [png_chunk(b"tRNS", b"\0"), png_chunk(b"eXIf", b"II*\0\x08\0\0\0\x01"), b"IDAT", b"IEND"]),
        ("PNG", "P", [png_chunk(b"PLTE", b"\1\2\3"), b"acTL", b"\0\0\0\0"]),
        ("PNG", "I;16", [b"\xff\xff"]),
        ("JPEG", "RGB", JPEG_PARTS),
        ("JPEG", "CMYK", JPEG_PARTS),
    ]
]


@examples(350)
@given(st.one_of(*IMAGES, png_files()), st.sampled_from(["image.png", "image.jpg"]))
@pytest.mark.filterwarnings("ignore")
def test_an_image_is_read_or_refused(folder, content, name):
    image = read_or_refuse(folder / name, content, lambda path: folders.read(path, 8))
    assert image is None or (image.shape, image.dtype) == ((3, 8, 8), torch.uint8)
