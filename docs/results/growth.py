"""Draw a doublet that grows from flat plates by the loss of a frozen network: `python docs/results/growth.py`.

The steps are those of examples/task_driven.py; the program writes growth.webp.
"""

import sys
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from tasklens.design.start import flat
from tasklens.materials.catalogues import builtin
from tasklens.optics.analysis.spots import lit_semi_diameters
from tasklens.optics.lens import Lens
from tasklens.optics.view import View, view_of_spec
from tasklens.settings.specification import Spec
from tasklens.show.cross_section import cross_section
from tasklens.show.panel import RIM

FOLDER = Path(__file__).parent
EVERY = 6
sys.path.append(str(FOLDER.parents[1] / "examples"))


def frame(lens: Lens, view: View, step: int, loss: float) -> Image.Image:
    """Draw the cross-section of a lens, at the same scale in all frames."""
    figure = Figure(figsize=(4.8, 3.6), layout="constrained")
    axes = figure.subplots()
    cross_section(axes, lens.with_clear_apertures(RIM * lit_semi_diameters(lens, view)), view)
    axes.set(xlim=(-0.4, 5.0), ylim=(-2.9, 2.6))
    axes.set_title(f"step {step}, loss {loss:.2f}", y=-0.02, fontsize=10)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.frombuffer("RGBA", canvas.get_width_height(), canvas.buffer_rgba()).convert("RGB")


def main() -> None:
    """Write growth.webp."""
    import task_driven  # the example

    plates, view = flat((builtin("COC"), builtin("OKP4")), Spec(), task_driven.LIMITS), view_of_spec(Spec())
    network, batches = task_driven.network_and_batches(task_driven.SETTINGS.steps)
    losses, frames = [], []
    for step, (lens, loss) in enumerate(task_driven.descend(plates, view, network, batches)):
        losses.append(loss)
        if step % EVERY == 0:
            frames.append(frame(lens, view, step, sum(losses[-EVERY:]) / len(losses[-EVERY:])))
    times = [100] * (len(frames) - 1) + [2000]
    frames[0].save(
        FOLDER / "growth.webp", save_all=True, append_images=frames[1:], duration=times, loop=0, quality=40, method=6
    )


if __name__ == "__main__":
    main()
