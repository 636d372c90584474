"""Task-driven lens design: the gradient of a classifier's loss passes through captures, PSFs and rays to the lens.

Functions (see `help()` of each):

    load_lens, save_lens    lens.yaml and Zemax files
    lens, draw              a lens from its surfaces; drawings
    trace, psf, analyse     rays, point spread functions, figures of a lens
    simulate                captures of an image, each entirely at one field
    simulate_whole_sensor   capture of an image by the whole sensor
    design_lens             a new lens
    rank                    ranking of lenses for a network
    Camera                  a lens in front of a network, for your own training loop
    PsfCamera               captures through fixed PSFs
    frozen                  a frozen copy of a network, faster by folded batch norms

Types: `Lens`, `View`, `Ranking`, `SensorSettings`. An argument or a file that cannot be used raises a ValueError,
nearly always `InputError`.
"""

import warnings
from importlib import import_module
from typing import Any

# torch itself raises this warning at the first forward-mode derivative of a process.
warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", FutureWarning)

_NAMES = {  # public names by module
    "tasklens.api.camera": ("Camera",),
    "tasklens.api.captures": ("simulate", "simulate_whole_sensor"),
    "tasklens.api.design": ("design_lens",),
    "tasklens.api.lenses": ("analyse", "draw", "lens", "load_lens", "psf", "save_lens", "trace"),
    "tasklens.api.ranking": ("Ranking", "rank"),
    "tasklens.camera.imaging": ("PsfCamera",),
    "tasklens.optics.lens": ("Lens",),
    "tasklens.optics.view": ("View",),
    "tasklens.recognition.classifiers": ("frozen",),
    "tasklens.runtime.errors": ("InputError",),
    "tasklens.settings.capture_settings": ("SensorSettings",),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    """Import a public name on first use: `import tasklens` alone imports neither torch nor numba."""
    if name == "__version__":
        return import_module("importlib.metadata").version("tasklens")
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'tasklens' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "__version__"])
