"""Lenses as YAML files that a person can read; lossless to the last bit of float64."""

import math
from pathlib import Path

import torch
import yaml

from tasklens.files import FileError, write_text
from tasklens.optics.lens import Lens
from tasklens.optics.materials import PLASTICS

FORMAT = 1


def to_dict(lens: Lens) -> dict:
    """The prescription of a lens as plain values: lengths in mm, alpha_2j in mm^(1 - 2j)."""
    surfaces = []
    for i, medium in enumerate(lens.media):
        alpha = {f"alpha_{2 * j}": a for j, a in enumerate(lens.alpha[i].double().tolist(), 1)}
        semi = float(lens.semi_diameter[i])
        surfaces.append(
            {
                "curvature": float(lens.curvature[i]),
                "conic": float(lens.conic[i]),
                **alpha,
                "thickness": float(lens.thickness[i]),
                "medium": medium,
                "semi_diameter": semi if math.isfinite(semi) else None,
            }
        )
    return {"format": FORMAT, "units": "mm", "stop": lens.stop, "surfaces": surfaces}


def from_dict(content: dict, name: str = "lens file") -> Lens:
    """The lens of a prescription; the last thickness is the image distance.

    Raises:
        FileError: another format, an unknown medium, a missing or unknown key; `name` begins its message.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else content
        raise FileError(f"{name}: format {found!r}, expected {FORMAT}")
    for key in ("surfaces", "stop"):
        if key not in content:
            raise FileError(f"{name}: has no {key}")
    surfaces = content["surfaces"]
    known = ("curvature", "conic", "thickness", "medium", "semi_diameter")
    orders = 0
    for i, surface in enumerate(surfaces):
        for key in known:
            if key not in surface:
                raise FileError(f"{name}: surface {i} has no {key}")
        if surface["medium"] != "air" and surface["medium"] not in PLASTICS:
            raise FileError(f"{name}: surface {i} has the unknown medium {surface['medium']!r}")
        for key in surface.keys() - set(known):
            letter, _, order = key.partition("_")
            if letter != "alpha" or not order.isdigit() or int(order) % 2 or int(order) < 2:
                raise FileError(f"{name}: surface {i} has an unknown key {key!r}")
            orders = max(orders, int(order) // 2)

    def column(key: str) -> torch.Tensor:
        return torch.tensor([float(s[key]) for s in surfaces], dtype=torch.float64)

    return Lens(
        curvature=column("curvature"),
        conic=column("conic"),
        alpha=torch.tensor(
            [[float(s.get(f"alpha_{2 * j}", 0.0)) for j in range(1, orders + 1)] for s in surfaces],
            dtype=torch.float64,
        ).reshape(len(surfaces), orders),
        thickness=column("thickness"),
        semi_diameter=torch.tensor(
            [math.inf if s["semi_diameter"] is None else float(s["semi_diameter"]) for s in surfaces],
            dtype=torch.float64,
        ),
        media=tuple(s["medium"] for s in surfaces),
        stop=int(content["stop"]),
    )


def write(path: Path, lens: Lens, notes: dict) -> None:
    """Write a lens file; `notes` (spec, what made it, figures) follow the prescription."""
    write_text(path, yaml.safe_dump(to_dict(lens) | notes, sort_keys=False))


def read(path: Path) -> tuple[Lens, dict]:
    """The lens in a file, and everything that the file says."""
    with open(path) as file:
        content = yaml.load(file, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    return from_dict(content, str(path)), content
