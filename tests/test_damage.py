"""Damaged results, full disks, full memory: the message names the file and the remedy."""

import os
import resource
import signal

import pytest
import torch

from restoration import nafnet
from tasklens.cli import app
from tasklens.optics.io import psf_files
from tasklens.recognition import dataset
from tasklens.recognition.metrics import mean_metrics
from tasklens.runtime import files
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.files import FileError, read_table, read_yaml, write_tensors
from tasklens.settings.network_settings import RestorationSettings
from tasklens.show import predictions
from tasklens.study.report.measurements import Measurements

NAFNET = RestorationSettings(width=4, encoder=(1,), decoder=(1,), steps=1)
SETS, NOTES = {"grading": (0, 2, 2), "corner": (1, 2, 1)}, {"fields_mm": [[0, 0], [1, 0]]}


def good_psfs() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    psf = torch.rand(2, 3, 5, 5, generator=generator)
    return psf / psf.sum((-2, -1), keepdim=True), torch.tensor([1.0, 0.6])


def test_psfs_come_back(tmp_path):
    psfs = good_psfs()
    path = tmp_path / "psf.safetensors"
    psf_files.write(path, *psfs, SETS, NOTES)
    for fields, part, turns in (("grading", slice(0, 2), 2), ("corner", slice(1, 2), 1)):
        psf, illumination, of_set = psf_files.read(path, fields)
        assert torch.equal(psf, psfs[0][part]) and torch.equal(illumination, psfs[1][part])
        assert of_set == turns
    with pytest.raises(FileError, match=r"psf\.safetensors: has no PSFs of the fields of nine; remove it"):
        psf_files.read(path, "nine")


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda psf, light: (psf[:1], light), "PSFs and illumination of 2 fields have the shapes"),
        (lambda psf, light: (psf[..., :4, :4], light), "shapes"),  # no central pixel
        (lambda psf, light: (psf[0], light), "shapes"),
        (lambda psf, light: (psf, light[:1]), "shapes"),
        (lambda psf, light: (psf * torch.nan, light), "not finite"),
        (lambda psf, light: (-psf, light), "negative"),
        (lambda psf, light: (2 * psf, light), "more than all the light"),
        (lambda psf, light: (psf, -light), "an illumination that is negative"),
    ],
)
def test_psfs_that_no_lens_has_are_named(tmp_path, change, words):
    path = tmp_path / "psf.safetensors"
    psf_files.write(path, *change(*good_psfs()), SETS, NOTES)
    with pytest.raises(FileError, match=r"psf\.safetensors: .*; delete it and run again") as error:
        psf_files.read(path, "grading")
    assert words in str(error.value)


def read_frozen(path):
    return Measurements({}, {}, frozen={("a", "b", 0): path}).frozen_losses("a", "b", 0)


TABLES = {
    mean_metrics: "field,metric,value\n0,accuracy,90.5\n1,accuracy,80.5\n",
    predictions.read: "image,label,field0,field1\n0,cat,1,0\n1,dog,1,1\n",
    read_frozen: "image,label,field0,field1\n0,cat,1.5,0.2\n1,dog,1.2,1.1\n",
    read_table: "a,b\n1,2\n",
}


@pytest.mark.parametrize("read", TABLES, ids=lambda read: read.__name__)
def test_a_table_that_is_cut_off_anywhere_is_named(tmp_path, read):
    """Cut at every byte except row ends; empty files, one junk byte and other files are named too."""
    path, text = tmp_path / "table.csv", TABLES[read]
    path.write_text(text)
    read(path)
    cuts = [text[:end] for end in range(len(text)) if text[end - 1 : end] != "\n"]
    others = [] if read is read_table else ["\0\n", text.replace(",", ";", 1)]  # valid tables, with other content
    for content in [*cuts, "\n", *others]:
        path.write_text(content)
        with pytest.raises(FileError, match=r"table\.csv: .*; delete it and run again"):
            read(path)


def test_results_of_other_kinds_are_named(tmp_path):
    weights = tmp_path / "nafnet.safetensors"
    write_tensors(weights, {"intro.weight": torch.ones(3)}, {})
    (tmp_path / "lens.yaml").write_text("figures: {rms: [1, 2")
    (tmp_path / "job.pt").write_bytes(b"PK\x03\x04 rubbish")
    (tmp_path / "images.npy").write_bytes(b"\x93NUMPY")
    calls = {
        "nafnet.safetensors": lambda: nafnet.load(NAFNET, weights),
        "lens.yaml": lambda: read_yaml(tmp_path / "lens.yaml"),
        "job.pt": lambda: Checkpoint(tmp_path / "job.pt"),
        "images.npy": lambda: dataset.read(tmp_path / "images.npy", tmp_path / "labels.json"),
    }
    for name, call in calls.items():
        with pytest.raises(FileError, match=f"{name}: .*(delete it and run again|remove it)"):
            call()


def in_a_fork(call) -> str:
    """Error of a call in a process with a file size limit of 4 kB, which acts like a full disk."""
    read, write = os.pipe()
    if not (process := os.fork()):
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
        try:
            call()
        except (OSError, FileError) as error:
            os.write(write, f"{type(error).__name__} {error}".encode()[:4000])
        finally:
            os._exit(0)
    os.close(write)
    os.waitpid(process, 0)
    return os.read(read, 4096).decode()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
@pytest.mark.parametrize("kind", ["text", "rows", "tensors", "checkpoint", "array"])
def test_a_file_that_does_not_fit_is_named_and_leaves_nothing(tmp_path, kind):
    def array():
        with files.writing_array(tmp_path / "large", (100, 100)) as pixels:
            pixels[:] = 1

    checkpoint = Checkpoint(tmp_path / "large")
    checkpoint.records = {"a": {"x": torch.ones(5000)}}
    calls = {
        "text": lambda: files.write_text(tmp_path / "large", "x" * 10_000),
        "rows": lambda: files.write_rows(tmp_path / "large", [{"a": "x" * 10_000}]),
        "tensors": lambda: write_tensors(tmp_path / "large", {"a": torch.ones(5000)}, {}),
        "checkpoint": checkpoint.write,
        "array": array,
    }
    message = in_a_fork(calls[kind])
    assert str(tmp_path / "large") in message, message
    assert not (tmp_path / "large").exists()


@pytest.mark.parametrize(
    "error, words",
    [
        (MemoryError(), "not enough memory"),
        (torch.OutOfMemoryError("CUDA out of memory"), "not enough memory (CUDA out of memory)"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "not enough memory"),
        (OSError(28, "No space left on device", "results/x.csv"), "results/x.csv: no space left on device"),
    ],
)
def test_full_memories_and_disks_are_one_line(monkeypatch, capsys, error, words):
    def fail(**_):
        raise error

    monkeypatch.setattr(app, "app", fail)
    assert app.main([]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("tasklens: ") and words in line
