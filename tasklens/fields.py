"""Fields over the sensor: sets of points, fractions (u, v) of its half width and half height; no torch here.

A rotationally symmetric lens sees one quadrant as the others. The centres of equal cells are uniform in area, but those
of few cells miss the corner. So images take the quarters of the cells in turns: four sets see 6 x 6 or 8 x 8 fields at
the cost of one.
"""

Points = tuple[tuple[float, float], ...]


def cell_centres(cells: int) -> Points:
    """Return the centres of `cells` x `cells` equal cells of the quadrant, row by row from the axis."""
    return tuple(((i + 0.5) / cells, (k + 0.5) / cells) for k in range(cells) for i in range(cells))


def quarters(cells: int) -> tuple[Points, ...]:
    """Return four sets of fields; each has the centres of the same quarter of `cells` x `cells` equal cells."""
    shift = 0.25 / cells  # from the centre of a cell
    return tuple(
        tuple((u + du, v + dv) for u, v in cell_centres(cells)) for dv in (-shift, shift) for du in (-shift, shift)
    )


PAPER: Points = tuple((u, v) for v in (0, 0.5, 1) for u in (0, 0.5, 1))  # of Yang et al. 2024
CELLS = 3  # columns and rows of cells in which the fields of a step are drawn
SELECTION = quarters(CELLS)  # for the validation of designs, and the choice among lenses
GRADING = quarters(4)  # for test images; no field is one of SELECTION or PAPER
GRADING_CENTRES = cell_centres(4)
CORNER: Points = ((1.0, 1.0),)
