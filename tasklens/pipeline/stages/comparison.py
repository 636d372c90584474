"""Figure of the task-driven lenses and the best imaging lens of some elements (the paper's figure 3)."""

from tasklens.report import figures
from tasklens.report.measurements import Measurements
from tasklens.runtime.files import Files
from tasklens.study.settings import Slice


def run(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Draw the lens of each claim, and their strongest baseline."""
    strongest = Measurements({}, inputs.metrics).strongest_baseline(settings.claims[0], settings.seed)
    lenses = [*(claim.lens for claim in settings.claims), strongest]
    panels = [figures.panel(lens, inputs.lenses[lens], inputs.psfs[lens]) for lens in lenses]
    figures.draw([outputs.figure, outputs.figure_svg, outputs.figure_pdf], panels)
