"""Programs and jobs: their exit status, an imported lens, and errors that are messages."""

import os
import subprocess
import sys

import pytest
import yaml
from examples import cooke_triplet, write
from rules import finish
from studies import changed, lens_file, result, tiny_study

from tasklens.cli.app import main
from tasklens.design.optimizers import AdamWOptimizer
from tasklens.optics.io import prescription
from tasklens.optics.io.prescription import Prescription
from tasklens.study.loading import load, parse

STUDY = parse(tiny_study())


def lens_content(lens: str, seed: int = 0) -> dict:
    return yaml.safe_load(lens_file("tiny", lens, seed).read_text())


@pytest.mark.parametrize(("environment", "policy"), [({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")])
def test_waiting_threads_sleep_unless_the_user_decides(environment, policy):
    """From before torch is imported, which reads it once. The program ends with its own exit status."""
    program = "import os, sys; from tasklens.runtime.job import run_program; "
    program += "run_program(lambda: sys.exit(print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules) or 3), None)"
    done = subprocess.run([sys.executable, "-c", program], env=os.environ | environment, capture_output=True, text=True)
    assert done.stdout.split() == [policy, "False"] and done.returncode == 3


def test_a_program_ends_with_all_that_it_printed(here):
    """It frees no memory at exit, but its output to a pipe is complete."""
    write("study.yaml", yaml.safe_dump(tiny_study()))
    program = [sys.executable, "-m", "tasklens.cli", "study", "check", "--no-weight-files", "study.yaml"]
    done = subprocess.run(program, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "tiny: 6 lenses, 2 classifiers, seeds [0]\n")


def test_a_design_that_diverges_says_so_in_its_lens_file(here, monkeypatch):
    """If the gradient is not finite at the third step, the lens of the second step is written."""
    change, steps = AdamWOptimizer.change, iter((1.0, 1.0, float("nan")))
    monkeypatch.setattr(AdamWOptimizer, "change", lambda *rest: next(steps) * change(*rest))
    finish("design", STUDY, lens="singlet-imaging1", seed=9)
    assert lens_content("singlet-imaging1", 9)["origin"]["diverged"].startswith("step 3: ")


@pytest.mark.slow
def test_an_imported_lens_goes_the_same_way(here, capsys):
    """From its file to its PSF and figure; `check` reports unusable lenses before any job."""
    prescription.write(here / "theirs.yaml", Prescription(cooke_triplet()), {})
    entry = {"elements": "triplet", "file": "theirs.yaml", "focus": "spot"}
    study = changed(tiny_study(), "imported.cooke", entry)
    path = here / "imported.yaml"
    path.write_text(yaml.safe_dump(changed(study, "spec.field_of_view_deg", 36)))
    for rule in ("design", "psfs", "certificate", "drawing"):
        finish(rule, load(path), lens="triplet-cooke", seed=0)
    content = lens_content("triplet-cooke")
    assert content["origin"]["file"] == "theirs.yaml" and content["stop"] == 4
    assert content["figures"]["efl_mm"] == pytest.approx(content["spec"]["efl_mm"], rel=1e-12)
    assert result("tiny", "figures/triplet-cooke-seed0.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert main(["study", "check", "--no-weight-files", "imported.yaml"]) == 0
    path.write_text(yaml.safe_dump(changed(study, "spec.field_of_view_deg", 120)))
    assert main(["study", "check", "--no-weight-files", "imported.yaml"]) == 2
    assert "theirs.yaml: does not cover the field" in capsys.readouterr().err
