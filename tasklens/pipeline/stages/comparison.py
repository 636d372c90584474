"""Figure of a task-driven and the best imaging lens (the paper's figure 3)."""

from tasklens.report import figures
from tasklens.report.measurements import Measurements
from tasklens.runtime.files import Files
from tasklens.study.settings import Slice


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Draw the lens of a claim and its strongest baseline."""
    lenses = (settings.claim.lens, Measurements({}, inputs.metrics).strongest_baseline(settings.claim, settings.seed))
    figures.draw(outputs.figure, [figures.panel(lens, inputs.lenses[lens], inputs.psfs[lens]) for lens in lenses])
