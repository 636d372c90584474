"""Files of jobs: written whole, by one writer at a time, and read back as they were."""

import os
import signal
import subprocess
import sys

import pytest
import torch

from tasklens.runtime import files


def test_tables_are_utf_8_in_every_locale(tmp_path):
    code = (
        "import sys, pathlib; from tasklens.runtime import files\n"
        "files.write_rows(pathlib.Path(sys.argv[1]), [{'class': 'K\\xe4fer'}, {'class': '\\u732b'}])"
    )
    ascii_locale = os.environ | {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "rows.csv")], check=True, env=ascii_locale)
    assert (tmp_path / "rows.csv").read_text(encoding="utf-8") == "class\nKäfer\n猫\n"


@pytest.mark.parametrize("before", [None, "old"])
def test_a_failing_writer_leaves_things_as_they_were(tmp_path, before):
    """No half-written file, no temporary; an older file stays."""
    path = tmp_path / "file.txt"
    if before is not None:
        path.write_text(before)
    with pytest.raises(RuntimeError, match="halfway"), files.replacing(path) as temporary:
        temporary.write_text("half")
        assert temporary.parent == path.parent  # otherwise the rename would not be atomic
        raise RuntimeError("halfway")
    assert [p.name for p in tmp_path.iterdir()] == ([] if before is None else ["file.txt"])
    assert before is None or path.read_text() == before


def test_a_killed_writer_leaves_nothing_that_looks_finished(tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from tasklens.runtime.files import replacing\n"
        "with replacing(Path(sys.argv[1])) as temporary:\n"
        "    temporary.write_text('half'); os.kill(os.getpid(), 9)"
    )
    path = tmp_path / "file.txt"
    process = subprocess.run([sys.executable, "-c", code, str(path)], env=os.environ)
    assert process.returncode == -signal.SIGKILL and not path.exists()
    assert len(list(tmp_path.iterdir())) == 1
    files.write_text(path, "whole")
    assert [p.name for p in tmp_path.iterdir()] == ["file.txt"]  # its leftover is gone


def test_two_writers_of_one_file_do_not_mix(tmp_path):
    """A process left over from a killed run, and its successor: each has a temporary file of its own."""
    code = (
        "import sys; from pathlib import Path; from tasklens.runtime.files import replacing\n"
        "with replacing(Path(sys.argv[1])) as temporary:\n"
        "    temporary.write_text('theirs'); print('begun', flush=True); input()"
    )
    path = tmp_path / "file.txt"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", code, str(path)], **pipes) as other:
        assert other.stdout.readline() == "begun\n"
        files.write_text(path, "ours")
        assert path.read_text() == "ours" and len(list(tmp_path.iterdir())) == 2
        other.communicate("go on\n")
    assert other.returncode == 0 and path.read_text() == "theirs" and [*tmp_path.iterdir()] == [path]


def test_an_array_remains_if_the_user_interrupts(tmp_path):
    """A conversion of photographs resumes after Ctrl-C; after an error it starts anew."""
    for error, remains in ((KeyboardInterrupt, True), (ValueError, False)):
        with pytest.raises(error), files.writing_array(tmp_path / "array.npy", (2,)) as array:
            array[:] = 5
            raise error
        assert files.resumable_of(tmp_path / "array.npy").exists() == remains
        if remains:
            with files.writing_array(tmp_path / "array.npy", (2,), begun=True) as array:
                assert array.tolist() == [5, 5]
            assert files.map_array(tmp_path / "array.npy").tolist() == [5, 5]


def test_rows_keep_all_columns(tmp_path):
    """Columns in order of appearance, gaps where a row has none."""
    files.write_rows(tmp_path / "rows.csv", [{"a": 1, "b": 0.1}, {"a": 2, "c": "x,y"}])
    assert (tmp_path / "rows.csv").read_text() == 'a,b,c\n1,0.1,\n2,,"x,y"\n'


def test_tensors_keep_values_and_metadata(tmp_path):
    tensors = {"a": torch.randn(2, 3, generator=torch.Generator().manual_seed(0)).T, "n": torch.arange(3)}
    files.write_tensors(tmp_path / "t.safetensors", tensors, {"fields": [[0, 0.5]], "name": "x"})
    loaded, notes = files.read_tensors(tmp_path / "t.safetensors")
    assert loaded.keys() == tensors.keys() and all(torch.equal(loaded[k], tensors[k]) for k in tensors)
    assert notes == {"fields": [[0, 0.5]], "name": "x"}


@pytest.mark.parametrize("keep", [0, 5, 40, -1])
def test_a_damaged_file_of_tensors_is_named(tmp_path, keep):
    path = tmp_path / "t.safetensors"
    files.write_tensors(path, {"a": torch.ones(3)}, {})
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(files.FileError, match=r"t\.safetensors: not a complete file of .*; delete it and run again"):
        files.read_tensors(path)
