"""Task-driven lens design: the gradient of a classifier's loss passes through captures, PSFs and rays to the lens.

For notebooks, with `help()` of each:

    load_lens, save_lens    lens.yaml and Zemax files
    lens, draw              a lens typed surface by surface; drawings
    trace, psf, analyse     rays, point spread functions, figures of a lens
    simulate                captures of an image, each as if all of it lay at one field
    simulate_sensor         capture of an image by the whole sensor
    design                  a new lens
    rank                    which lens for a network
    Camera                  a lens in front of a network, in a training loop of your own
"""

import warnings
from importlib import import_module
from typing import Any

# torch causes this warning itself, at the first forward-mode derivative of a process.
warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", FutureWarning)

__all__ = [
    "Camera",
    "analyse",
    "design",
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


def __getattr__(name: str) -> Any:
    """Import what is asked for: `import tasklens` by itself imports nothing, neither torch nor numba."""
    if name == "design":  # a package that can be called: see there
        return import_module("tasklens.design")
    if name == "__version__":
        return import_module("importlib.metadata").version("tasklens")
    if name in __all__:
        return getattr(import_module("tasklens.notebook"), name)
    raise AttributeError(f"module 'tasklens' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "__version__"])
