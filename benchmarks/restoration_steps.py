"""Convergence of the restorations of a finished study: PSNR with their steps, and with twice as many.

    python benchmarks/restoration_steps.py results/small --lenses doublet-tasklens doublet-image_psnr

Both trainings begin anew with the first seed of the study; the PSNR is that of 64 minival images at all fields.
"""

import time
from pathlib import Path

import timing

from restoration import nafnet_training
from tasklens.recognition import dataset
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.study import loading, report_jobs


def main(arguments: list[str] | None = None) -> None:
    parser = timing.arguments(__doc__)
    parser.add_argument("results", type=Path, help="folder of a finished study")
    parser.add_argument("--lenses", nargs="+", help="by default all of table 4")
    options = parser.parse_args(arguments)
    study = loading.load(options.results / "study.yaml")
    images, minival = (
        dataset.read(*(options.results / "images" / f"{split}.{kind}" for kind in ("npy", "json")))
        for split in ("train", "minival")
    )
    rows = []
    for lens in options.lenses or report_jobs.CapturesJob.of(study).restored_lenses:
        seed = study.seeds[0]
        path = options.results / "lenses" / lens / f"seed{seed}" / "psf.safetensors"
        pipelines = [
            CapturePipeline.of(study.capture_of(lens), path, fields, images.device)
            for fields in ("training", "selection")
        ]
        quality, seconds = [], []
        for steps in (study.restoration.steps, 2 * study.restoration.steps):
            settings = study.restoration.model_copy(update={"steps": 2 if options.tiny else steps})
            begin = time.process_time()
            _, history = nafnet_training.train(settings, images, minival, *pipelines, seed)
            quality.append(history[-1]["psnr_db"])
            seconds.append(time.process_time() - begin)
        numbers = (f"{quality[0]:.2f}", f"{quality[1]:.2f}", f"{quality[1] - quality[0]:+.2f}")
        rows.append((lens, study.restoration.steps, *numbers, *(f"{value:.0f}" for value in seconds)))
    columns = (
        "lens",
        "steps",
        "PSNR [dB]",
        "with twice as many",
        "difference",
        "time [s]",
        "time of twice as many [s]",
    )
    timing.report(f"Restorations of the study {study.name}", columns, rows, options.save)


if __name__ == "__main__":
    main()
