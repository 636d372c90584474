"""Bad inputs of bad_inputs.yaml: the command line ends in seconds, with one message that names what is wrong.

Messages about a study file are in the words of the file, not in those of pydantic.
"""

import os
import re
import resource
import shutil
import signal
import sys
import traceback
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import pytest
import torch  # noqa: F401  # imported once, before the processes are forked
import yaml
from examples import HEADLINE, write
from studies import changed, tiny_study
from zemax_texts import LENS_TEXT

from tasklens.cli.app import main
from tasklens.materials.catalogues import PLASTICS
from tasklens.recognition import classifiers  # noqa: F401
from tasklens.study.loading import parse
from tasklens.study.study import Study, StudyError

DOUBLET = HEADLINE / "doublet-imaging2.yaml"
CORPUS = yaml.safe_load(Path(__file__).with_name("bad_inputs.yaml").read_text())
INNER_WORDS = re.compile(  # words of pydantic and Python that no message to the user may contain
    r"Input should|Field required|Extra inputs|Value error|\b(union|tagged|discriminator|pydantic|tuple|dict|validation"
    r"|NoneType|mapping)\b|Settings\b|function-|should be strings",
    re.IGNORECASE,
)
SECONDS, BYTES = 20, 2**30  # processor time of a message, which takes a thousandth of it; waiting may take ten times it


def study(case: Mapping) -> list[str]:
    content = tiny_study()
    for key, value in ({case["key"]: case["value"]} | case.get("also", {})).items():
        content = changed(content, key, value)
    text = yaml.safe_dump(content, allow_unicode=True, sort_keys=False)
    write("study.yaml", text.replace("PLASTICS", str(PLASTICS)).replace("PROGRAM", __file__))
    return ["study", "check", "study.yaml", "--no-weight-files"]


def network(case: Mapping) -> list[str]:
    return [*study(case), "--build-networks"]


def text(case: Mapping) -> list[str]:
    old, count = case.get("times", ("", 0))
    written = case["text"].replace(str(old), count * str(old)) if count else case["text"]
    Path("study.yaml").write_bytes(written.encode(case.get("encoding", "utf-8")))
    return ["study", "check", "study.yaml"]


def lens(case: Mapping) -> list[str]:
    content = yaml.safe_load(DOUBLET.read_text()) | {"wavelengths_um": [0.6563, 0.5893, 0.4861], "primary": 1}
    if "drop" in case:
        drop(content, case["drop"])
    else:
        content = changed(content, case["key"], case["value"])
    write("lens.yaml", yaml.safe_dump(content))
    return ["lens", "show", "lens.yaml"]


def drop(content, key: str) -> None:
    """Remove the value at a dotted key; numbers index lists."""
    *above, last = key.split(".")
    for name in above:
        content = content[int(name) if isinstance(content, list) else name]
    del content[last]


def zemax(case: Mapping) -> list[str]:
    assert case["old"] in LENS_TEXT
    write("lens.zmx", LENS_TEXT.replace(case["old"], case["new"], 1))
    return ["lens", "show", "lens.zmx"]


def catalogue(case: Mapping) -> list[str]:
    write(case["file"], case["text"])
    return study({"key": "materials", "value": [case["file"]]})


def folder(case: Mapping) -> list[str]:
    Path("images").mkdir()
    for name, content in case["files"].items():
        path = Path("images", name)
        path.parent.mkdir(parents=True, exist_ok=True)
        if content == "pipe":
            os.mkfifo(path)
        elif content.startswith("-> "):
            path.symlink_to(content.removeprefix("-> "))
        else:
            path.write_text(content)
    return study({"key": "images", "value": {"folder": "images", "size": 16, "minival": 2}})


def command(case: Mapping) -> list[str]:
    write("study.yaml", yaml.safe_dump(tiny_study()))
    shutil.copy(DOUBLET, "lens.yaml")
    write("lens.zmx", LENS_TEXT)
    write("words.png", "no image")
    write("broken.yaml", "a: [")
    write("part.yaml", "seeds: [1]\n")
    Path("folder").mkdir()
    for name in ("pipe.yaml", "pipe.zmx", "pipe.png"):
        os.mkfifo(name)
    # an image of 60000 x 60000 pixels in a few bytes
    Path("bomb.png").write_bytes(
        bytes.fromhex("89504e470d0a1a0a0000000d494844520000ea600000ea6001000000000b5ad8c50000000049454e44ae426082")
    )
    return case["command"]


KINDS = {
    "studies": study,
    "networks": network,
    "texts": text,
    "lenses": lens,
    "zemax": zemax,
    "catalogues": catalogue,
    "folders": folder,
    "commands": command,
}
CASES = [
    pytest.param(partial(KINDS[kind], case), case["says"], id=f"{kind}-{number}-{case.get('key') or case.get('drop')}")
    for kind, cases in CORPUS.items()
    for number, case in enumerate(cases)
]


def run(arguments: list[str]) -> tuple[int, str]:
    """Exit status and standard error of the command line in a forked process, of bounded time and memory."""
    if not (process := os.fork()):
        sys.stdout = sys.stderr = os.fdopen(os.open("errors", os.O_CREAT | os.O_WRONLY), "w")
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(10 * SECONDS)
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        memory = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (memory + BYTES, memory + BYTES))
        try:
            status = main(arguments)
            sys.stderr.flush()
            os._exit(status)
        finally:
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(99)
    _, status = os.waitpid(process, 0)
    return os.waitstatus_to_exitcode(status), Path("errors").read_text()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
@pytest.mark.parametrize("prepare, says", CASES)
def test_a_bad_input_is_refused(here, capsys, prepare, says):
    arguments = prepare()
    files = {*os.listdir(), "errors", ".snakemake"}
    if prepare.func in (study, lens, zemax, catalogue):  # hundreds of small texts, which are only parsed
        status, message = main(arguments), capsys.readouterr().err
        assert prepare.func is not study or not INNER_WORDS.search(message), message
    else:
        status, message = run(arguments)
    assert status == 2, message
    first, *others = message.splitlines()
    assert first.startswith(("tasklens: ", "Usage: ")) and len(others) < 12, message
    assert not others or first.startswith("Usage: ") or first.endswith("the study cannot be run:"), message
    assert [words for words in says if words not in message] == [], message
    assert {*os.listdir()} <= files  # nothing is written, nor is code in a file run


def test_the_file_and_all_its_mistakes_are_named(tmp_path, capsys):
    """On standard error, with exit status 2."""
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(changed(tiny_study(), "seed", 3)))
    assert main(["study", "check", str(path)]) == 2
    assert capsys.readouterr().err == f"tasklens: {path}: seed = 3: unknown key; did you mean seeds?\n"
    path.write_text(yaml.safe_dump(changed(changed(tiny_study(), "seed", 3), "spec.f_number", "fast")))
    assert main(["study", "check", str(path)]) == 2
    first, *lines = capsys.readouterr().err.splitlines()
    assert first == f"tasklens: {path}: the study cannot be run:"
    assert lines == ["  spec.f_number = 'fast': expected a number", "  seed = 3: unknown key; did you mean seeds?"]


def keys(study: object, at: str = "") -> list[str]:
    """All keys of a study at any depth, and indices of list entries."""
    inner = study.items() if isinstance(study, dict) else enumerate(study) if isinstance(study, list) else ()
    return [key for name, value in inner for key in (f"{at}{name}", *keys(value, f"{at}{name}."))]


@pytest.mark.parametrize("value", [None, -1, "word", ["word"], {"word": 1}, {3: 4}])
def test_no_inner_word_reaches_the_user(value):
    """Any value at any key of a study; most combinations are refused."""
    refused = 0
    for key in sorted({*Study.model_fields, *keys(tiny_study())}):
        try:
            parse(changed(tiny_study(), key, value))
        except StudyError as error:
            refused += 1
            assert not INNER_WORDS.search(str(error)), (key, str(error))
    assert refused > 20
