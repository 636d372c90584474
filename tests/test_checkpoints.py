"""Jobs that are killed and run again end as if they had not been."""

import itertools
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml
from examples import changed, random_images, tiny_study
from test_design import descended, small_network

from tasklens.cli.app import main
from tasklens.design import supervision
from tasklens.pipeline.digest import digest_of
from tasklens.recognition import evaluation, training
from tasklens.runtime import checkpoints
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.files import FileError, read_tensors
from tasklens.study.settings import TrainingSettings

STUDY = changed(tiny_study(), "designs.tasklens.augment", True)  # draws from torch's own generator
_TRAINING = {"epochs": 1, "learning_rate": 1e-3, "batch_size": 20}
_VIT = {"img_size": 16, "patch_size": 8, "drop_path_rate": 0.5}  # draws, too
STUDY["classifiers"] = {
    "small": STUDY["classifiers"]["small"],
    "other": {"model": "test_vit", "arguments": _VIT, "training": _TRAINING},
    "third": {"model": "test_vit", "arguments": _VIT | {"drop_path_rate": 0.1}, "training": _TRAINING},
}
JOBS = {
    "reference": ["reference", "small"],
    "least_squares": ["design", "singlet-imaging2"],
    "spot": ["design", "singlet-imaging1"],
    "task": ["design", "singlet-tasklens"],
    "end_to_end": ["design", "singlet-end_to_end_from_flat"],
    "restoration": ["restore", "singlet-imaging1"],
    "fine_tuning": ["fine-tune", "singlet-imaging1", "small"],
    "fine_tuning_others": ["fine-tune-others", "singlet-imaging1"],
    "reproduction": ["reproduce", "singlet-imaging1", "small"],
}


class Killed(BaseException):
    """Stands for a signal: no stage catches it."""


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """The tiny study with what the jobs read."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "study.yaml").write_text(yaml.safe_dump(STUDY))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for job in (["images"], *(["reference", name] for name in STUDY["classifiers"]), JOBS["spot"]):
            assert run(*job) == 0
        yield folder


def run(stage: str, *arguments: str) -> int:
    return main(["run", stage, "study.yaml", *arguments])


def outputs(before: float) -> dict[str, bytes]:
    """All files that were written since, but the locks of jobs, by their paths."""
    found = [path for path in Path("results/tiny").rglob("*") if path.is_file() and "locks" not in path.parts]
    return {str(path): path.read_bytes() for path in found if path.stat().st_mtime >= before}


@pytest.mark.parametrize("job", JOBS)
def test_a_killed_job_ends_with_the_same_numbers(workplace, monkeypatch, job):
    """To the last bit, in every file, wherever it is killed; the checkpoint is gone then."""
    monkeypatch.setattr(evaluation, "_BATCH", 8)
    if job == "reproduction":
        assert run(*JOBS["fine_tuning"]) == 0
    start = time.time()
    assert run(*JOBS[job]) == 0
    expected = outputs(start)
    assert len(expected) > 1 or job in ("reference", "reproduction")
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    for killed_at in itertools.count(1):
        writes = itertools.count(1)

        def write(self, write=Checkpoint.write, writes=writes, killed_at=killed_at):
            write(self)
            if next(writes) == killed_at:
                raise Killed

        for path in expected:
            Path(path).unlink()
        try:
            with monkeypatch.context() as patch:
                patch.setattr(Checkpoint, "write", write)
                run(*JOBS[job])
        except Killed:
            assert not any(Path(path).exists() for path in expected)
            assert len(list(Path("results/tiny/checkpoints").iterdir())) == 1
            torch.manual_seed(99)  # what a new process has drawn is nothing to it
            assert run(*JOBS[job]) == 0
        else:
            break  # it writes less often
        assert {path: Path(path).read_bytes() for path in expected} == expected
        assert not list(Path("results/tiny/checkpoints").iterdir())
    assert killed_at > 2


def test_classifiers_are_fine_tuned_together_as_if_alone(workplace):
    """The same weights, metrics and predictions, to the last bit, with random numbers of their own."""
    start = time.time()
    assert run(*JOBS["fine_tuning_others"]) == 0
    expected = outputs(start)
    assert len(expected) == 8
    for name in ("third", "other"):
        for path in expected:
            if name in path:
                Path(path).unlink()
        assert run("fine-tune", "singlet-imaging1", name) == 0
    assert {path: Path(path).read_bytes() for path in expected} == expected


def test_a_network_that_is_not_trained_is_measured_once(workplace, monkeypatch):
    """Without epochs: minival images are captured once, for losses and accuracy; weights are those of the reference."""
    captured = []
    evaluate = evaluation.evaluate
    monkeypatch.setattr(evaluation, "evaluate", lambda *rest: captured.append(len(rest[1])) or evaluate(*rest))
    assert run(*JOBS["fine_tuning"]) == 0
    folder = Path("results/tiny/metrics/singlet-imaging1/seed0")
    losses = (folder / "small-frozen.csv").read_bytes()
    assert captured == [10, 20, 10]
    Path("study.yaml").write_text(yaml.safe_dump(changed(STUDY, "fine_tuning.epochs", 0)))
    captured.clear()
    assert run(*JOBS["fine_tuning"]) == 0
    assert captured == [10, 20]
    assert (folder / "small-frozen.csv").read_bytes() == losses
    weights = [
        read_tensors(Path(f"results/tiny/classifiers/{place}/small.safetensors"))[0]
        for place in ("reference", "singlet-imaging1/seed0")
    ]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())
    Path("study.yaml").write_text(yaml.safe_dump(STUDY))


def test_a_resumed_descent_that_diverges_ends_with_its_last_lens(start, monkeypatch, tmp_path):
    """Not with the one that it began with: what was finite last is kept, too."""
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    losses = supervision.loss_at_psf

    def breaking(*rest):
        found, gradient = losses(*rest)
        return (found * torch.nan if next(steps) > 3 else found), gradient

    def ended(checkpoint: Checkpoint):
        return descended(small_network(), start, steps=6, checkpoint=checkpoint)[0]

    monkeypatch.setattr(supervision, "loss_at_psf", breaking)
    steps = itertools.count(1)
    expected = ended(Checkpoint(tmp_path / "job.pt"))
    steps = itertools.count(4)  # the fourth breaks again
    assert torch.equal(ended(Checkpoint(tmp_path / "job.pt")).curvature, expected.curvature)
    assert not torch.equal(expected.curvature, start.curvature)


def test_a_changed_job_begins_anew(workplace, monkeypatch):
    """Another step count, and no trace of the old checkpoint is left."""
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)

    def killed(self, write=Checkpoint.write):
        write(self)
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(Checkpoint, "write", killed)
        run(*JOBS["spot"])
    (old,) = Path("results/tiny/checkpoints").iterdir()
    Path("study.yaml").write_text(yaml.safe_dump(changed(STUDY, "designs.imaging1.descents.0.steps", 4)))
    found = []
    monkeypatch.setattr(Checkpoint, "write", lambda self: found.append((self.path, next(iter(self.records.values())))))
    assert run(*JOBS["spot"]) == 0
    assert [record.get("step") for _, record in found] == [1, 2, 3, 4, None]  # the last: what it ended with
    assert not old.exists() and found[0][0] != old
    Path("study.yaml").write_text(yaml.safe_dump(STUDY))
    assert run(*JOBS["spot"]) == 0


def test_a_process_that_is_killed_leaves_a_whole_checkpoint(workplace):
    """SIGKILL, which nothing can catch, in the middle of a design; the next process ends it."""
    command = "from tasklens.cli.app import main\nfrom tasklens.runtime import checkpoints\n"
    command += "checkpoints.INTERVAL = 0.0\nmain()"
    call = [sys.executable, "-c", command, "run", "design", "study.yaml", "singlet-tasklens"]
    assert run(*JOBS["task"]) == 0
    lens = Path("results/tiny/lenses/singlet-tasklens/seed0/lens.yaml")
    expected = lens.read_bytes()
    lens.unlink()
    process = subprocess.Popen(call, stderr=subprocess.DEVNULL)
    while not list(Path("results/tiny").glob("checkpoints/*.pt")):
        assert process.poll() is None
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert not lens.exists()
    assert run(*JOBS["task"]) == 0
    assert lens.read_bytes() == expected


def test_a_process_that_is_killed_while_it_writes_leaves_nothing_for_ever(tmp_path):
    """Its half file goes with the checkpoint, also if that is never written again."""
    process = subprocess.Popen(["true"])
    process.wait()
    half = tmp_path / f".job.pt.{socket.gethostname()}-{process.pid}.part"
    half.write_bytes(b"half")
    Checkpoint(tmp_path / "job.pt").remove()
    assert not half.exists()


def test_a_job_killed_in_its_evaluation_keeps_what_it_learned(monkeypatch, tmp_path):
    """Also if the file was last written in the middle of the training, and then in the evaluation, both times whole."""
    settings = TrainingSettings(epochs=1, learning_rate=1e-2, batch_size=10)
    dataset, path = random_images(80, 16, 3, seed=1), tmp_path / "job.pt"
    due = iter([*(step == 3 for step in range(1, 9)), False, True])  # after step 3; at the end; in the evaluation
    monkeypatch.setattr(Checkpoint, "due", lambda self: next(due))
    network, checkpoint = small_network(0), Checkpoint(path)
    training.fit({"network": network}, dataset, settings, 0, "fine-tune", checkpoint=checkpoint)
    checkpoint.part("test").save(1, correct=torch.ones(3))
    monkeypatch.setattr(training._Trainee, "step", None)  # nothing is trained again
    resumed = small_network(1)
    training.fit({"network": resumed}, dataset, settings, 0, "fine-tune", checkpoint=Checkpoint(path))
    assert all(torch.equal(value, network.state_dict()[name]) for name, value in resumed.state_dict().items())


def test_a_saved_state_does_not_change_with_its_network(monkeypatch, tmp_path):
    """A part that was saved, but not finished, when a later part writes the file."""
    network, checkpoint = torch.nn.Linear(2, 2), Checkpoint(tmp_path / "job.pt")
    before = network.weight.detach().clone()
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    checkpoint.part("training", network=network).save(1)
    with torch.no_grad():
        network.weight += 1
    checkpoint.part("test").save(1)
    Checkpoint(tmp_path / "job.pt").part("training", network=network)
    assert torch.equal(network.weight, before)


def test_a_state_that_is_not_finite_is_not_kept(tmp_path, monkeypatch):
    """The last good one stays."""
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    path = tmp_path / "job.pt"
    part = Checkpoint(path).part("descent")
    part.history.append({"step": 1})
    part.save(1, vector=torch.tensor([1.0, 2.0]))
    part.save(2, vector=torch.tensor([1.0, torch.nan]))
    again = Checkpoint(path).part("descent")
    assert again.step == 1 and again.state["vector"].tolist() == [1.0, 2.0] and again.history == [{"step": 1}]


def test_a_file_that_is_no_checkpoint_is_named(tmp_path):
    (tmp_path / "job.pt").write_bytes(b"something else")
    with pytest.raises(FileError, match=r"job\.pt: no checkpoint"):
        Checkpoint(tmp_path / "job.pt")


def test_keys_follow_what_is_computed(tmp_path):
    (tmp_path / "input").write_text("1")
    first = digest_of("slice", "code", inputs=[tmp_path / "input"])
    assert first == digest_of("slice", "code", inputs=[tmp_path / "input"])
    found = {first, digest_of("slice", "other code", inputs=[tmp_path / "input"]), digest_of("slice", "code")}
    (tmp_path / "input").write_text("12")
    assert len(found | {digest_of("slice", "code", inputs=[tmp_path / "input"])}) == 4
