"""Methods of lens design; `tasklens.design(...)` designs one lens without a study.

    lens, view, notes = tasklens.design("least_squares", ["COC", "OKP4"], f_number=2.8)
    tasklens.save_lens("lens.yaml", lens, view, notes)

Arguments:

    method       least_squares, spot, image_quality, image_error, correlation; with a network task, joint, end_to_end
    elements     materials from front to back, by name, built-in or from `materials`; "COC|PMMA" lets the design choose:
                 it tries all combinations in brief least-squares designs, and takes the sharpest
    seed         seed of all random numbers
    settings     settings of the method, by the keys of a study file: {"evaluations": 2000},
                 {"descents": {"0": {"steps": 200}}}
    constraints  limits that differ from the defaults of a study: {"max_track": 6.0} [mm]
    materials    files of further plastics (.yaml, .agf)
    images       folder of photographs: <class>/*, or train/<class>/*; or a torch dataset, or pairs (image, label);
                 by default rendered textures
    size         side of the photographs [pixels]
    classifier   the network: {"model": "resnet18", "weights": "resnet.safetensors", "outputs": "classes"}
    network      trained torch.nn.Module instead of `classifier`, from images (B, 3, H, W) in [0, 1] to logits
    loss         loss(network(captures), labels) instead of cross-entropy: one number, or one per image
    start        file of a lens to improve (.zmx, lens.yaml), instead of `elements`: its glasses stay, and limits that
                 it violates are relaxed to its own values
    free         free variables of `start`: {"curvature": [0, 1], "thickness": None}, surfaces numbered from 0, None:
                 all; also alpha_4 .. alpha_10; by default curvatures, distances, and the coefficients of aspheres
    f_number, field_of_view_deg, diagonal_mm, pixel_pitch_um, kernel_size, wavelengths_um, aspect
                 specification; by default that of the paper: F/2.8, 68.8 degrees, 4 mm, 1.8 um, 51 pixels

It returns the lens, the view (fields, wavelengths, pixels), and notes for its file: spec, origin, figures, margins.
The starting lenses of a method are designed first. A doublet by least squares takes a minute.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    """The package as a function, so that `tasklens.design(...)` works although it is the name of this package."""

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        # Imported by name, so that jobs that import a module of this package do not depend on `single`.
        return import_module("tasklens.design.single").design(*arguments, **keywords)


sys.modules[__name__].__class__ = _Callable
