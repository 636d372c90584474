"""Bad inputs of bad_inputs.yaml: the command line ends in seconds, with one message that names what is wrong."""

import os
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
from examples import changed, tiny_study, write
from inner_words import INNER_WORDS
from zemax_texts import LENS_TEXT

from tasklens.cli.app import main
from tasklens.materials.catalogues import PLASTICS
from tasklens.recognition import classifiers  # noqa: F401

DOUBLET = Path(__file__).parents[1] / "docs/results/headline/lenses/doublet-imaging2.yaml"
CORPUS = yaml.safe_load(Path(__file__).with_name("bad_inputs.yaml").read_text())
SECONDS, BYTES = 20, 2**30  # time limit of a message; a thousandth of it is usual

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")


def study(case: Mapping) -> list[str]:
    text = yaml.safe_dump(changed(tiny_study(), case["key"], case["value"]), allow_unicode=True, sort_keys=False)
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
    write("lens.yaml", yaml.safe_dump(changed(yaml.safe_load(DOUBLET.read_text()), case["key"], case["value"])))
    return ["lens", "show", "lens.yaml"]


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
    pytest.param(partial(KINDS[kind], case), case["says"], id=f"{kind}-{number}-{case.get('key', '')}")
    for kind, cases in CORPUS.items()
    for number, case in enumerate(cases)
]


def run(arguments: list[str]) -> tuple[int, str]:
    """Exit status and standard error of the command line in a forked process, of bounded time and memory."""
    if not (process := os.fork()):
        sys.stdout = sys.stderr = os.fdopen(os.open("errors", os.O_CREAT | os.O_WRONLY), "w")
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(SECONDS)
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


@pytest.mark.parametrize("prepare, says", CASES)
def test_a_bad_input_is_refused(tmp_path, monkeypatch, capsys, prepare, says):
    monkeypatch.chdir(tmp_path)
    if prepare.func in (study, lens, zemax, catalogue):  # hundreds of small texts, which are only parsed
        status, message = main(prepare()), capsys.readouterr().err
        assert prepare.func is not study or not INNER_WORDS.search(message), message
    else:
        status, message = run(prepare())
    assert status == 2, message
    assert "Traceback" not in message and len(message.splitlines()) <= 12, message
    assert [words for words in says if words not in message] == [], message
    assert not Path("broken").exists()  # written only if code in a file was run
