"""Lenses typed surface by surface."""

import tasklens

TYPED = {"field_of_view_deg": 30, "f_number": 4, "pixel_pitch_um": 4.0, "kernel_size": 15}


def singlet(front: float = 1.6, **changes) -> tuple:
    """A lens of one element; typed without a last thickness, it is in focus."""
    surfaces = [{"radius": front, "thickness": 0.7, "material": "COC", "stop": True}, {"radius": -4.0}]
    return tasklens.lens(surfaces, **(TYPED | changes))
