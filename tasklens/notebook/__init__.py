"""Functions for notebooks, which `import tasklens` offers.

A lens is a `Lens` (surfaces, distances, media: tensors that gradients flow through) and is looked at with a `View`
(fields, wavelengths, pixels). Lengths are in mm, wavelengths, pixels and spots in um.

    import tasklens

    lens, view = tasklens.load_lens("lens.yaml")
    tasklens.analyse(lens, view)["rms_centroid_um"]
    captures = tasklens.simulate("photograph.jpg", lens, view)
"""

from tasklens.notebook.camera import Camera
from tasklens.notebook.captures import simulate, simulate_sensor
from tasklens.notebook.lenses import analyse, described, draw, lens, load_lens, psf, save_lens, trace
from tasklens.notebook.ranking import Ranking, rank

__all__ = [
    "Camera",
    "Ranking",
    "analyse",
    "described",
    "draw",
    "lens",
    "load_lens",
    "psf",
    "rank",
    "save_lens",
    "simulate",
    "simulate_sensor",
    "trace",
]
