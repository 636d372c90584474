"""The public functions, available through `import tasklens`.

A `Lens` has surfaces, distances and media (differentiable tensors). A `View` has the fields, wavelengths and pixels at
which it is evaluated. Lengths are in mm; wavelengths, pixels and spots are in um.

    import tasklens

    lens, view = tasklens.load_lens("lens.yaml")
    tasklens.analyse(lens, view)["rms_centroid_um"]
    captures = tasklens.simulate(lens, view, "photograph.jpg")
"""

from tasklens.api.camera import Camera
from tasklens.api.captures import simulate, simulate_whole_sensor
from tasklens.api.design import design_lens
from tasklens.api.lenses import analyse, described, draw, lens, load_lens, psf, save_lens, trace
from tasklens.api.ranking import Ranking, rank

__all__ = [
    "Camera",
    "Ranking",
    "analyse",
    "described",
    "design_lens",
    "draw",
    "lens",
    "load_lens",
    "psf",
    "rank",
    "save_lens",
    "simulate",
    "simulate_whole_sensor",
    "trace",
]
