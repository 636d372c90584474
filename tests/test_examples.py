"""Examples: the short example takes the same steps as the package."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from designs import LIMITS, VIEW, problem, tiny_network
from examples import load_script, materials

from tasklens.design import descent
from tasklens.design.criteria import TaskLoss
from tasklens.design.objective import Objective
from tasklens.design.start import flat
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.recognition.training import Shuffled
from tasklens.settings.design_settings import GradientDesignSettings
from tasklens.settings.specification import Spec

EXAMPLES = Path(__file__).parents[1] / "examples"


def example(name: str):
    return load_script(EXAMPLES / f"{name}.py")


@pytest.mark.slow
def test_the_task_driven_example_takes_the_steps_of_a_descent(monkeypatch):
    """The same losses in six steps from flat plates, through the same rays."""
    network, posed, seed = tiny_network().eval().requires_grad_(False), problem(), -1  # the example counts from 0
    plates, module = flat(materials("COC", "OKP4"), Spec(kernel_size=11), LIMITS), example("task_driven")
    monkeypatch.setattr(descent, "sobol_disc", lambda count, seed: sobol_disc(count, 0))
    part = module.SETTINGS.model_copy(update={"steps": 6})
    design = GradientDesignSettings(descents=[part], batch_size=4, rays=32)
    ours = descent.Descent(
        plates, Objective(TaskLoss(network), posed, None, False, 36, "chief_ray"), design, part, seed
    )
    losses = [ours.step(step)[0]["loss"] for step in range(1, 7)]
    order = Shuffled(12, 4, torch.Generator().manual_seed(seed))
    batches = [posed.dataset.batch(order.next()) for _ in range(6)]
    steps = list(module.descend(plates, VIEW, network, batches, part, rays=32))
    assert [loss for _, loss in steps] == pytest.approx(losses, rel=1e-5)
    assert not torch.equal(steps[-1][0].curvature, plates.curvature)


@pytest.mark.slow
def test_the_task_driven_example_makes_a_lens(here, capsys):
    """The loss falls by a third within sixty steps."""
    module = example("task_driven")
    module.main(module.SETTINGS.model_copy(update={"steps": 60}), epochs=2)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("step")]
    losses = [float(line.split()[3].rstrip(",")) for line in lines]
    assert losses[-1] < 0.67 * losses[0] and (here / "task_driven.yaml").exists()


NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))
LAST = {  # file that the last cell writes
    "which_lens": "ranking.html",
    "own_network": "own_network.html",
    "trace_and_differentiate": "triplet.zmx",
}
BRIEF = {  # what is shortened, by notebook: a network that recognises something is enough
    "which_lens": [("render(1500, ", "render(600, "), ("render(200, ", "render(80, ")],
    "own_network": [
        ("textures(2000,", "textures(800,"),
        ("lambda sharp: sharp, 400,", "lambda sharp: sharp, 120,"),
        ("unseen, answers = textures(300,", "unseen, answers = textures(100,"),
        ('"evaluations": 1500, "starts": 4', '"evaluations": 150, "starts": 2'),
        ("fixed, 60,", "fixed, 5,"),
        ("camera, 60,", "camera, 5,"),
        ('"steps": 150', '"steps": 5'),
    ],
}


def cells(notebook: Path) -> list[str]:
    """Code cells of a notebook, which is stored with what they print and display."""
    content = json.loads(notebook.read_text(encoding="utf-8"))
    code = [cell for cell in content["cells"] if cell["cell_type"] == "code"]
    outputs = [output for cell in code for output in cell["outputs"]]
    assert content["nbformat"] == 4 and [cell["execution_count"] for cell in code] == [*range(1, len(code) + 1)]
    assert any("data" in output for output in outputs) and all(output.get("name") != "stderr" for output in outputs)
    return ["".join(cell["source"]) for cell in code]


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_without_the_repository(notebook, tmp_path):
    """All cells in order, in an empty folder, with fewer steps; the cells print results."""
    code = "\n\n".join(cells(notebook))
    for text, brief in BRIEF.get(notebook.stem, []):
        assert text in code
        code = code.replace(text, brief)
    (tmp_path / "cells.py").write_text(code)
    variables = os.environ | {"MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, "cells.py"], cwd=tmp_path, env=variables, capture_output=True, text=True, timeout=400
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") >= 3
    # Lenses of a few steps may be better at the nine fields than between them.
    assert done.stderr.count("Warning") == done.stderr.count("is fitted to the paper's nine fields")
    assert (tmp_path / LAST[notebook.stem]).exists()


def test_there_are_notebooks():
    assert {path.stem for path in NOTEBOOKS} == set(LAST)
