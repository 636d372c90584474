"""Fields over the sensor: sets of points, fractions (u, v) of its half width and half height; no torch here.

A rotationally symmetric lens sees one quadrant as the others. The centres of equal cells are uniform in area.
"""

Points = tuple[tuple[float, float], ...]


def cell_centres(columns: int, rows: int) -> Points:
    """Return the centres of a grid of equal cells over the quadrant, row by row from the axis."""
    return tuple(((i + 0.5) / columns, (k + 0.5) / rows) for k in range(rows) for i in range(columns))


PAPER: Points = tuple((u, v) for v in (0, 0.5, 1) for u in (0, 0.5, 1))  # of Yang et al. 2024
CELLS = 3  # columns and rows of cells in which the fields of a step are drawn
SELECTION = cell_centres(CELLS, CELLS)  # validate designs, and choose among lenses
GRADING = cell_centres(4, 4)  # of the cells of a grading
_SHIFT = 1 / 16  # from the centre of such a cell to that of its quarter
QUARTERS: tuple[Points, ...] = tuple(  # of the cells, which images take in turns; none is in SELECTION or PAPER
    tuple((u + du, v + dv) for u, v in GRADING) for dv in (-_SHIFT, _SHIFT) for du in (-_SHIFT, _SHIFT)
)
GRADED: Points = sum(QUARTERS, ())  # all of them, turn by turn
CORNER: Points = ((1.0, 1.0),)
