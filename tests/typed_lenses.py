"""Lenses typed surface by surface."""

import tasklens

TYPED = {"field_of_view_deg": 30, "f_number": 4, "pixel_pitch_um": 4.0, "kernel_size": 15}


def singlet(front: float = 1.6, **changes) -> tuple:
    """A lens of one element; typed without a last thickness, it is in focus."""
    surfaces = [{"radius": front, "thickness": 0.7, "material": "COC", "stop": True}, {"radius": -4.0}]
    return tasklens.lens(surfaces, **(TYPED | changes))


COOKE = [
    {"radius": 22.01359, "thickness": 3.25896, "material": "SK16"},
    {"radius": -435.76044, "thickness": 6.00755},
    {"radius": -22.21328, "thickness": 0.99997, "material": "F2"},
    {"curvature": 1 / 20.29192, "thickness": 4.75041, "stop": True},
    {"radius": 79.6836, "thickness": 2.95208, "material": "SK16"},
    {"radius": -18.39533, "thickness": 42.2},
]
