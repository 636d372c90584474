"""Property-based fuzzing of all files that a user writes: each is accepted, or refused with an error that names it.

The profile is fixed, so that every run has the same examples. To search for longer, with other examples each time:

    TASKLENS_FUZZ=100 pytest tests/test_fuzz.py -n 0

runs a hundred times as many. Add failures to bad_inputs.yaml.
"""

import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from damage import HOSTILE, PLAIN, altered_text, changed_content, dump_yaml
from hypothesis import HealthCheck, Phase, event, given, settings
from hypothesis import strategies as st
from prescriptions import random_prescription, same_bits
from studies import tiny_study
from zemax_texts import CATALOGUE_TEXT, LENS_TEXT

from tasklens.materials import catalogues
from tasklens.optics.io import prescription, zemax
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


def read_or_refuse(path: Path, content: str, read: Callable, error: type[InputError] = FileError):
    """Return the result of `read`, or None if it refuses the file with the right kind of error that names it."""
    path.write_bytes(content.encode("utf-8"))
    try:
        with bounded():
            result = read(path)
    except error as refusal:
        assert type(refusal) is error and path.name in str(refusal)
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
    return loading.resolve(loading.parse(study))


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
            assert [loading.parse(loading.resolve(point)) for point in points] == points


@pytest.mark.slow
@examples(110)
@given(changed_content(STUDY))
def test_a_study_is_read_or_refused(folder, content):
    check_study(folder / "study.yaml", dump_yaml(content))


YAML_WORDS = ["- ", "? ", ": ", "{", "}", "[", "]", "&a", "*a", "<<", "!!", "!!set", "|", ">-", "---", "..."]
YAML_WORDS += ["%YAML 9.9", "#", '"', "'", "\t", "\r", "\x85", "\u2028", "\ufeff", "\0", *PLAIN, *HOSTILE]


@examples(60)
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


@pytest.mark.slow
@examples(85)
@given(changed_content(LENS))
def test_a_lens_file_is_read_or_refused(folder, content):
    result = read_or_refuse(folder / "lens.yaml", dump_yaml(content), prescription.read)
    if result is not None:
        check_yaml_lens(folder / "again.yaml", result[0])


ZEMAX_WORDS = sorted({word for line in LENS_TEXT.split("\n") for word in line.split()})
ZEMAX_WORDS += ["XASPHERE", "XDAT", "EVENASPH", "INFINITY", "FNUM", "FLOA", "CLAP", "WAVL", "IN", "METER", "MIRROR"]
ZEMAX_WORDS.append("\0")


def check_zemax(path: Path, content: str) -> None:
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
    check_yaml_lens(path.with_name("again.yaml"), replace(lens, remarks=()))


@examples(85)
@given(altered_text(LENS_TEXT, ZEMAX_WORDS))
def test_a_zemax_file_is_read_or_refused(folder, text):
    check_zemax(folder / "lens.zmx", text)


OPERANDS = "THIC CRVT CONN GLSS MIND MABB MDPG SDIA APMN APMX APTP APDX PRAM PAR1 PAR9 EDVA STPS APER SATP APDT APDF"
OPERANDS += " FLTP PRWV XFIE YFIE WAVE WLWT FVCY IGNR TELE TEMP CBTX TSP1"
VALUES = ["0", "1", "2", "3", "9", "-1", "0.4", "1e-3", "1E+10", "1e400", "COC", "MIRROR", "INFINITY", "x", '""']
ROWS = st.builds(
    " ".join,
    st.tuples(
        st.sampled_from(OPERANDS.split()),
        st.sampled_from(["0", "1", "2", "3", "4", "6", "7", "-1", "1.5"]),
        st.sampled_from(["1", "1", "2", "0"]),
        st.sampled_from(VALUES),
        st.sampled_from(["0 0 0 1 1 1 0 0", "0 2 0 1 1 1 0 0", ""]),
    ),
)


@examples(85)
@given(st.lists(ROWS, min_size=1, max_size=6), st.sampled_from(["ENPD 1.2", "FLOA", "FNUM 2.8 1"]))
def test_a_zemax_file_with_contradictory_operands_is_read_or_refused(folder, rows, aperture):
    text = LENS_TEXT.replace("ENPD 1.2", aperture).replace("MNUM 1 1", "\n".join(["MNUM 2 1", *rows]))
    check_zemax(folder / "lens.zmx", text)


AGF_WORDS = ["NM", "CD", "LD", "GC", "ED", "TD", "OD", "MIRROR", "___BLANK", "air", "13", "1e-320", "INFINITY"]


def check_agf(path: Path, content: str) -> None:
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


@examples(75)
@given(altered_text(CATALOGUE_TEXT, AGF_WORDS) | st.text(max_size=40))
def test_a_catalogue_is_read_or_refused(folder, text):
    check_agf(folder / "maker.agf", text.encode("utf-8", "surrogatepass").decode("utf-8", "replace"))
