"""Existing lenses: our spots, MTF, distortion and illumination compared with Optiland's and with published numbers.

    python benchmarks/existing_lenses.py [--csv existing_lenses.csv] [--lenses US8310767B2 lens1]

The lenses are those in tests/data/lenses and, if the folder exists, in ../shared/data/lenses. Without Optiland (pip
install optiland) its columns are empty. A star marks a difference beyond the tolerance of its table; the reasons are in
docs/results/existing_lenses.md.
"""

import time
import warnings

import pandas
from lens_cases import SPOT_UM, read
from optiland_comparisons import (
    DISTORTION_PERCENT,
    ILLUMINATION,
    MTF,
    captures,
    distortions,
    illuminations,
    mtfs,
    spots,
)
from published_comparisons import CODEV, codev, file_spots, focal_lengths
from reference_lenses import LENS_FILES
from timing import arguments, report

TABLES = (
    (
        f"RMS spot radius about the centroid, d line [um], fields 0 / 0.5 / 0.7 / 1; star: beyond {SPOT_UM} um",
        ("lens", "ours", "Optiland", "share of rays that Optiland passes", "difference", "ray by ray"),
        spots,
    ),
    (
        f"The same through the paraxial pupil beside the files' reference; star: beyond {SPOT_UM} um",
        (
            *("lens", "ours", "file", "difference"),
            *("share of rays inside the vertex planes", "share that the file has", "difference of these alone"),
        ),
        file_spots,
    ),
    (
        f"Geometric MTF, d line, fields 0 / 0.5 / 0.7 / 1; star: beyond {MTF}",
        ("lens", "cycles/mm", "tangential: ours", "Optiland", "sagittal: ours", "Optiland", "difference"),
        mtfs,
    ),
    (
        f"Distortion [%] at half and all of the field angle, d line; star: beyond {DISTORTION_PERCENT}, ten fields",
        ("lens", "ours", "Optiland", "difference"),
        distortions,
    ),
    (
        f"Relative illumination at fields 0.5 / 0.7 / 1, d line; star: beyond {ILLUMINATION}",
        ("lens", "ours", "by Optiland's rays", "difference", "cos^4"),
        illuminations,
    ),
    (
        f"Largest RMS spot diameter over the fields of the file [um]; star: both beyond {100 * CODEV:g} %",
        (
            *("lens", "object [mm]", "CODE V", "ours", "difference [%]"),
            *("clipped by the file's radii", "difference [%]", "least share of rays"),
        ),
        codev,
    ),
    (
        "Captures of 16 images through PSFs of 51 pixels, fields 0 / 0.5 / 0.7 / 1; empty where Optiland loses rays",
        (
            *("lens", "pixels [um]", "PSNR of the sharp image [dB]", "PSNR of the capture by Optiland's rays [dB]"),
            "largest difference of a pixel [levels of 255]",
        ),
        captures,
    ),
    ("Focal length [mm]", ("lens", "ours", "Optiland", "published", "difference [%]"), focal_lengths),
)


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--lenses", nargs="+", metavar="NAME", help="only these")
    parser.add_argument("--csv", metavar="FILE", help="write all tables, a row for each number")
    options = parser.parse_args(argv)
    warnings.filterwarnings("ignore")  # Optiland's, of rays that miss a surface
    try:
        import optiland_lenses as peer
    except ImportError:
        peer = None
    paths = [path for path in LENS_FILES if path.stem in (options.lenses or [path.stem])]
    begin = time.perf_counter()
    cases = [read(path, peer) for path in (paths[:1] if options.tiny else paths)]
    cells = []
    for title, columns, rows in TABLES:
        table = list(rows(cases, options.tiny))
        report(title, columns, table, options.save)
        cells += [(rows.__name__, lens, *cell) for lens, *row in table for cell in zip(columns[1:], row, strict=True)]
    if options.csv:
        pandas.DataFrame(cells, columns=["table", "lens", "column", "value"]).to_csv(options.csv, index=False)
    print(f"{len(cases)} lenses, {time.perf_counter() - begin:.0f} s", flush=True)


if __name__ == "__main__":
    main()
