"""A finished study, verified: what comes out again, and what is said where it does not."""

import json
from pathlib import Path

import pytest
import yaml
from examples import read_rows, tiny_study

from tasklens.cli.app import main
from tasklens.pipeline import jobs, report_jobs
from tasklens.runtime.files import read_tensors, write_tensors
from tasklens.study.loading import parse
from tasklens.study.names import split
from tasklens.study.study import TABLES
from tasklens.study.tables import verification

TINY = tiny_study() | {"name": "verified", "classifiers": {"small": tiny_study()["classifiers"]["small"]}}
STUDY = parse(TINY)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with the tiny study of one classifier: all tables, and every measurement reproduced."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "verified.yaml").write_text(yaml.safe_dump(TINY))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        make()
        yield folder


def make() -> None:
    """All stages, in the order in which they need each other."""
    assert verified("images") == verified("reference", "small") == 0
    imaging = list(STUDY.imaging_designs)
    for name in (*imaging, *(name for name in STUDY.designs if name not in imaging)):
        assert verified("design", f"singlet-{name}") == 0
        if name in imaging:  # what the end-to-end design starts from is judged first
            assert verified("fine-tune", f"singlet-{name}", "small") == 0
    for lens, name in verification(STUDY).measured:
        if split(name)[1]:
            assert verified("restore", lens) == 0
        for stage in ("fine-tune", "reproduce"):
            assert verified(stage, lens, name) == 0
    for stage in (*(["table", name] for name in TABLES), ["verdicts"], ["psf-tail"]):
        assert verified(*stage) == 0


def verified(stage: str, *arguments: str) -> int:
    return main(["run", stage, "verified.yaml", *arguments])


def measured(output: str, lens: str, measured_name: str = "small") -> Path:
    return jobs.fine_tune.output(STUDY, output, lens=lens, measured_name=measured_name, seed=0)


def accuracies(path: Path) -> list[float]:
    return [float(row["value"]) for row in read_rows(path) if row["metric"] == "accuracy"]


def failed(printed: str) -> list[str]:
    return [line for line in printed.splitlines() if line.startswith("failed: ")]


def test_predictions_are_kept(finished):
    """A row per test image with its label; their means are the accuracies of the metrics file."""
    found = read_rows(measured("predictions", "singlet-imaging1"))
    labels = json.loads(jobs.images.output(STUDY, "test_labels").read_text())
    assert [row["image"] for row in found] == [str(k) for k in range(20)]
    assert [row["label"] for row in found] == [labels["classes"][k] for k in labels["labels"]]
    means = [100 * sum(int(row[f"field{k}"]) for row in found) / 20 for k in range(9)]
    assert means == pytest.approx(accuracies(measured("metrics", "singlet-imaging1")))
    assert list(read_rows(measured("predictions", "sharp"))[0]) == ["image", "label", "field0"]


def test_checkpoints_of_finished_jobs_are_gone(finished):
    assert not list(finished.glob("results/verified/checkpoints/*"))


def test_verify_fails_for_the_limits_that_short_designs_violate_and_for_nothing_else(finished, capsys):
    """Designs of 3 steps violate limits: each violated one is named, exit status 1; all measurements come out again.

    End-to-end design from flat, which need not converge, is not held to them.
    """
    capsys.readouterr()
    assert verified("verify") == 1
    printed = capsys.readouterr().out
    violated: dict[str, set] = {"failed": set(), "unconstrained": set()}
    for name in STUDY.designs:
        path = jobs.design.output(STUDY, "lens", lens=f"singlet-{name}", seed=0)
        margins = yaml.safe_load(path.read_text())["margins"]
        said = "unconstrained" if name == "end_to_end_from_flat" else "failed"
        violated[said] |= {
            f"{said}: singlet-{name} seed 0: {limit}" for limit, value in margins.items() if value < -1e-6
        }
    converging = [line for line in printed.splitlines() if "not converged" in line]
    assert all(line.startswith("failed: singlet-tasklens seed 0: not converged: the loss of") for line in converging)
    lines = [line.rpartition(": margin")[0] for line in printed.splitlines() if line not in converging]
    for said, expected in violated.items():
        assert expected and {line for line in lines if line.startswith(f"{said}: ")} == expected
    assert f"Checked 6 lenses and 11 measurements: {len(violated['failed']) + len(converging)} failures." in printed
    assert "Verdicts on the paper's claims" in printed and "fewer than five seeds" in printed


@pytest.mark.parametrize("name", ["small", "small-restored"])
def test_other_weights_do_not_reproduce(finished, capsys, name):
    """The stored head turned to other classes: the captures that this changes are counted."""
    path = measured("weights", "singlet-imaging1", name)
    weights, notes = read_tensors(path)
    weights = {key: tensor.clone() for key, tensor in weights.items()}
    turned = {key: t.roll(1, 0) if t.shape[:1] == (10,) else t for key, t in weights.items()}
    try:
        write_tensors(path, turned, notes)
        assert verified("reproduce", "singlet-imaging1", name) == 0
        assert verified("verify") == 1
        said = f"failed: singlet-imaging1 seed 0: {name}: stored predictions: "
        assert any(line.startswith(said) for line in capsys.readouterr().out.splitlines())
    finally:
        write_tensors(path, weights, notes)
        assert verified("reproduce", "singlet-imaging1", name) == 0


def test_tails_of_all_lenses(finished):
    found = read_rows(report_jobs.psf_tail.output(STUDY, "csv"))
    assert sorted(row["lens"] for row in found) == sorted(f"singlet-{name}" for name in STUDY.designs)
    curves = read_rows(report_jobs.psf_tail.output(STUDY, "encircled_energy"))
    assert {row["lens"] for row in curves} == {row["lens"] for row in found}
    assert all(0 <= float(row["fraction"]) <= 1 for row in curves)
