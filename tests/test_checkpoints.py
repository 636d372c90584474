"""Jobs that are killed and run again give the same results as uninterrupted jobs."""

import itertools
import os
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from designs import adamw_descent, tiny_network
from examples import random_images
from rules import finish, job_of
from studies import changed, tiny_study

from tasklens.design import criteria
from tasklens.recognition import evaluation, training
from tasklens.runtime import checkpoints
from tasklens.runtime import job as runtime_job
from tasklens.runtime.checkpoints import Checkpoint
from tasklens.runtime.files import read_tensors
from tasklens.settings.network_settings import TrainingSettings
from tasklens.study.loading import parse

STUDY = changed(tiny_study(), "designs.tasklens.augment", True)  # draws from torch's own generator
# Wide limits: the repair of a finished lens has no checkpoint, and would take most of the time.
STUDY["constraints"] = {"efl_tolerance": 0.9, "distortion": 0.9, "max_slope": 3.0, "max_track": 9.0}
_TRAINING = {"epochs": 1, "learning_rate": 1e-3, "batch_size": 20}
_VIT = {"img_size": 16, "patch_size": 8, "drop_path_rate": 0.5}  # draws, too
STUDY["classifiers"] = {
    "small": STUDY["classifiers"]["small"],
    "other": {"model": "test_vit", "arguments": _VIT, "training": _TRAINING},
    "third": {"model": "test_vit", "arguments": _VIT | {"drop_path_rate": 0.1}, "training": _TRAINING},
}
LENS = {"lens": "singlet-imaging1", "seed": 0}
JOBS = {
    "reference": ("reference", {"classifier": "small"}),
    "least_squares": ("design", {"lens": "singlet-imaging2", "seed": 0}),
    "spot": ("design", LENS),
    "task": ("design", {"lens": "singlet-tasklens", "seed": 0}),
    "end_to_end": ("design", {"lens": "singlet-end_to_end_from_flat", "seed": 0}),
    "restoration": ("restore", LENS),
    "fine_tuning": ("fine_tune", LENS | {"measured_name": "small"}),
    "reproduction": ("reproduce", LENS | {"measured_name": "small"}),
}


class Killed(BaseException):
    """Replaces a signal: no stage catches it."""


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """The tiny study with the inputs of the jobs."""
    folder = tmp_path_factory.mktemp("study")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        finish("images", parse(STUDY))
        run("reference")
        run("spot")
        finish("psfs", parse(STUDY), **LENS)
        yield folder


def run(job: str, study: dict = STUDY) -> None:
    rule, wildcards = JOBS[job]
    finish(rule, parse(study), **wildcards)


def outputs(before: float) -> dict[str, bytes]:
    """All files written since `before`, except job locks, by path."""
    paths = [path for path in Path("results/tiny").rglob("*") if path.is_file() and "locks" not in path.parts]
    return {str(path): path.read_bytes() for path in paths if path.stat().st_mtime >= before}


@pytest.mark.parametrize(
    "job", [pytest.param(job, marks=pytest.mark.slow) if job in ("task", "end_to_end") else job for job in JOBS]
)
def test_a_killed_job_ends_with_the_same_numbers(workplace, monkeypatch, job):
    """To the last bit, in every file, if it is killed after 1, 2, 4, ... writes; at the end the checkpoint is gone."""
    monkeypatch.setattr(evaluation, "_BATCH", 8)
    if job == "reproduction":
        run("fine_tuning")
    start = time.time()
    run(job)
    expected = outputs(start)
    assert len(expected) > 1 or job in ("reference", "reproduction")
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    for killed_at in (2**k for k in itertools.count()):
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
                run(job)
        except Killed:
            assert not any(Path(path).exists() for path in expected)
            assert len(list(Path("results/tiny/checkpoints").iterdir())) == 1
            torch.manual_seed(99)  # random draws of the new process do not matter
            run(job)
        else:
            break  # it writes less often
        assert {path: Path(path).read_bytes() for path in expected} == expected
        assert not list(Path("results/tiny/checkpoints").iterdir())
    assert killed_at > 2


def test_a_network_that_is_not_trained_is_measured_once(workplace, monkeypatch):
    """Without epochs: minival images are captured once, for losses and accuracy; weights are those of the reference.

    Test images are captured over the sensor, and in the corner.
    """
    captured = []
    evaluate = evaluation.evaluate
    monkeypatch.setattr(evaluation, "evaluate", lambda *rest: captured.append(len(rest[1])) or evaluate(*rest))
    run("fine_tuning")
    folder = Path("results/tiny/metrics/singlet-imaging1/seed0")
    losses = (folder / "small-frozen.csv").read_bytes()
    assert captured == [10, 10, 20, 20]
    captured.clear()
    run("fine_tuning", changed(STUDY, "fine_tuning.epochs", 0))
    assert captured == [10, 20, 20]
    assert (folder / "small-frozen.csv").read_bytes() == losses
    weights = [
        read_tensors(Path(f"results/tiny/classifiers/{place}/small.safetensors"))[0]
        for place in ("reference", "singlet-imaging1/seed0")
    ]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())


def test_a_resumed_descent_that_diverges_ends_with_its_last_lens(start, monkeypatch, tmp_path):
    """Not with its start: the last finite lens is part of the checkpoint."""
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    losses = criteria.loss_at_psf

    def breaking(*rest):
        values, gradient = losses(*rest)
        return (values * torch.nan if next(steps) > 3 else values), gradient

    def final_lens(checkpoint: Checkpoint):
        return adamw_descent(tiny_network(), start, steps=6, checkpoint=checkpoint)[0]

    monkeypatch.setattr(criteria, "loss_at_psf", breaking)
    steps = itertools.count(1)
    expected = final_lens(Checkpoint(tmp_path / "job.pt"))
    steps = itertools.count(4)  # the fourth breaks again
    assert torch.equal(final_lens(Checkpoint(tmp_path / "job.pt")).curvature, expected.curvature)
    assert not torch.equal(expected.curvature, start.curvature)


def test_a_changed_job_begins_anew(workplace, monkeypatch):
    """A changed step count restarts the job and removes the old checkpoint."""
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)

    def killed(self, write=Checkpoint.write):
        write(self)
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(Checkpoint, "write", killed)
        run("spot")
    (old,) = Path("results/tiny/checkpoints").iterdir()
    saves = []
    monkeypatch.setattr(Checkpoint, "write", lambda self: saves.append((self.path, next(iter(self.records.values())))))
    run("spot", changed(STUDY, "designs.imaging1.descents.0.steps", 4))
    assert [record.get("step") for _, record in saves] == [1, 2, 3, 4, None]  # the last record is the result
    assert not old.exists() and saves[0][0] != old
    run("spot")


def test_a_job_killed_in_its_evaluation_keeps_what_it_learned(monkeypatch, tmp_path):
    """Even if the checkpoint was last written during the training and then during the evaluation."""
    settings = TrainingSettings(epochs=1, learning_rate=1e-2, batch_size=10)
    dataset, path = random_images(80, 16, 3, seed=1), tmp_path / "job.pt"
    due = iter([*(step == 3 for step in range(1, 9)), False, True])  # after step 3; at the end; in the evaluation
    monkeypatch.setattr(Checkpoint, "due", lambda self: next(due))
    network, checkpoint = tiny_network(0), Checkpoint(path)
    training.fit(network, dataset, settings, 0, "fine-tune", checkpoint=checkpoint)
    checkpoint.part("test").save(1, correct=torch.ones(3))
    monkeypatch.setattr(torch.optim.AdamW, "step", None)  # nothing is trained again
    resumed = tiny_network(1)
    training.fit(resumed, dataset, settings, 0, "fine-tune", checkpoint=Checkpoint(path))
    assert all(torch.equal(value, network.state_dict()[name]) for name, value in resumed.state_dict().items())


def test_a_saved_state_does_not_change_with_its_network(monkeypatch, tmp_path):
    """A saved but unfinished part stays as it was when a later part writes the file."""
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
    """The last finite state stays."""
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    path = tmp_path / "job.pt"
    part = Checkpoint(path).part("descent")
    part.history.append({"step": 1})
    part.save(1, vector=torch.tensor([1.0, 2.0]))
    part.save(2, vector=torch.tensor([1.0, torch.nan]))
    again = Checkpoint(path).part("descent")
    assert again.step == 1 and again.state["vector"].tolist() == [1.0, 2.0] and again.history == [{"step": 1}]


def test_keys_follow_what_is_computed(workplace, monkeypatch):
    """A checkpoint of other settings, code or inputs is not used."""
    rule, wildcards = JOBS["fine_tuning"]
    job, keys = job_of(rule, parse(STUDY), **wildcards), []
    checkpoint_path = runtime_job._checkpoint_path
    monkeypatch.setattr(
        runtime_job, "_checkpoint_path", lambda key, name: keys.append(key) or checkpoint_path(key, name)
    )
    for variant in (job, job, replace(job, code="other"), replace(job, settings=job.settings.replace("0.05", "0.06"))):
        variant.run()
    os.utime(job.inputs["reference"])
    job.run()
    assert keys[0] == keys[1] and len(set(keys)) == 4
