"""A whole sensor through a lens: times and memory, against patch-wise rendering and against its transforms alone.

Patch-wise rendering cuts the frame into as many patches as there are nodes, and convolves each with the PSF of its
node: it has seams. The floor is the forward and inverse transforms of tiles and PSFs that are already in memory.
The memory is that of a process that traces and blends once.
"""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from pathlib import Path

import timing
import torch
import torch.nn.functional as F
from torch import Tensor

from tasklens import load_lens
from tasklens.camera.blend import SensorPsfs, _fast_size, _hats, blend
from tasklens.camera.sensor_psfs import pitch_on_sensor, trace_sensor_psfs
from tasklens.optics.lens import Lens
from tasklens.optics.view import View

LENSES = Path(__file__).parents[1] / "docs" / "results" / "headline" / "lenses"
FRAME, TINY = (1080, 1920), (96, 128)


def trace(lens: Lens, view: View, shape: tuple[int, int]) -> SensorPsfs:
    """PSFs over the sensor; 4096 rays each."""
    return trace_sensor_psfs(lens, view, shape, pitch_on_sensor(lens, view, shape), 64 if shape == TINY else 4096)


def once(path: Path, shape: tuple[int, int]) -> tuple[float, float, float]:
    """Processor time of tracing and of blending [s], and peak memory [GB], in a separate process."""
    lens, view = load_lens(path)
    trace_sensor_psfs(lens, view, (40, 40), 50.0, 16)  # compiled code is loaded
    image = torch.rand(3, *shape, generator=torch.Generator().manual_seed(0))
    begin = time.process_time()
    psfs = trace(lens, view, shape)
    middle = time.process_time()
    blend(image, psfs)
    return middle - begin, time.process_time() - middle, timing.peak_memory_gib() * 1.0737


def patches(image: Tensor, psfs: SensorPsfs, by_fft: bool) -> Tensor:
    """Convolve each patch of the frame, reflected at the edges, with the core of the PSF of its node."""
    _, height, width = image.shape
    reach = psfs.core.shape[-1] // 2
    padded = F.pad(image[None], (reach,) * 4, mode="reflect")[0]
    capture = torch.empty_like(image)
    rows, columns = 2 * len(psfs.y) - 1, 2 * len(psfs.x) - 1
    for i, (top, bottom) in enumerate(pairwise(k * height // rows for k in range(rows + 1))):
        for j, (left, right) in enumerate(pairwise(k * width // columns for k in range(columns + 1))):
            kernel = psfs.core[abs(i - rows // 2), abs(j - columns // 2)]
            patch = padded[:, top : bottom + 2 * reach, left : right + 2 * reach]
            if by_fft:
                size = [_fast_size(n) for n in patch.shape[1:]]
                product = torch.fft.rfft2(patch, size) * torch.fft.rfft2(kernel, size)
                spread = torch.fft.irfft2(product, size)[:, 2 * reach :, 2 * reach :]
                capture[:, top:bottom, left:right] = spread[:, : bottom - top, : right - left]
            else:
                capture[:, top:bottom, left:right] = F.conv2d(patch[None], kernel[:, None], groups=3)[0]
    return capture


def transforms(psfs: SensorPsfs) -> None:
    """The transforms of all tiles and their PSFs, and back, a row of tiles at once."""
    for kernels, step in ((psfs.core, 1), (psfs.halo, psfs.halo_pixel)):
        if kernels is None:
            continue
        reach = kernels.shape[-1] - 1
        rows, columns = (
            [_fast_size(len(hat.weights) + reach) for hat in _hats(half, pixels, -(-pixels // step), step)]
            for half, pixels in zip((psfs.y, psfs.x), psfs.shape, strict=True)
        )
        for height in rows:
            for width in dict.fromkeys(columns):
                tiles = torch.zeros(columns.count(width), 3, height, width)
                spectra = torch.fft.rfft2(tiles)
                torch.fft.rfft2(tiles)
                torch.fft.irfft2(spectra, (height, width))


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("--lenses", nargs="+", default=["doublet-tasklens", "triplet-tasklens"], help="of the headline")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args(arguments)
    shape = TINY if options.tiny else FRAME
    rows, first = [], {}
    for name in options.lenses:  # first of all: a new process would count memory of this one as its own
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            first[name] = process.submit(once, LENSES / f"{name}.yaml", shape).result()
    for name, (traced, blended, memory) in first.items():
        path = LENSES / f"{name}.yaml"
        psfs = trace(*load_lens(path), shape)
        core = SensorPsfs(psfs.shape, psfs.y, psfs.x, psfs.core)
        image = torch.rand(3, *shape, generator=torch.Generator().manual_seed(0))
        work = {
            "blend": lambda image=image, psfs=psfs: blend(image, psfs),
            "core": lambda image=image, core=core: blend(image, core),
            "floor": lambda psfs=psfs: transforms(psfs),
            "fft": lambda image=image, core=core: patches(image, core, True),
            "conv2d": lambda image=image, core=core: patches(image, core, False),
        }
        times = timing.alternate(work, options.rounds)
        nodes = f"{2 * len(psfs.y) - 1} x {2 * len(psfs.x) - 1}{'' if psfs.halo is None else ', halo'}"
        both = f"{traced + blended:.1f}", f"{traced:.1f}", timing.spread(times["blend"]), f"{memory:.2f}"
        against = [timing.ratio(times[slow], times["core"]) for slow in ("fft", "conv2d")]
        rows.append((name, nodes, *both, *against, timing.ratio(times["blend"], times["floor"])))
    columns = (
        "lens",
        "nodes",
        "first frame [s]",
        "of it tracing [s]",
        "each further frame [s]",
        "peak [GB]",
        "patches by FFT over blending",
        "by conv2d over blending",
        "over floor",
    )
    timing.report(f"A frame of {shape[0]} x {shape[1]} pixels, PSF traced at nodes", columns, rows, options.save)


if __name__ == "__main__":
    main()
