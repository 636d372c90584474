"""Zero-shot accuracy of a study's published network through its lenses, on photographs of any of ImageNet's classes.

    python benchmarks/other_photographs.py results/photographs/study.yaml FOLDER [--designs tasklens image_psnr]

FOLDER has a folder per class, named by its WordNet id. No lens was designed and no network trained with its
photographs. Variants of ablations are designs too; lenses without results are left out. Each difference is the first
design minus another one, with a 95 % interval over photographs and seeds.
"""

import tempfile
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy
import pandas
import torch
from timing import arguments, report

from tasklens.imaging import PsfCamera
from tasklens.optics.io import psf_files
from tasklens.recognition import classifiers, dataset, evaluation
from tasklens.report import bootstrap
from tasklens.study import loading
from tasklens.study.names import SHARP
from tasklens.study.settings import ImageSettings
from tasklens.study.study import Study

DESIGNS = ("tasklens", "image_psnr", "image_contrast", "image_error", "imaging2")


def accuracies(study: Study, folder: Path, lenses: Sequence[str]) -> dict[str, pandas.DataFrame]:
    """Accuracy [%] of each photograph, mean over fields, by lens, sharp ones first: a column per seed."""
    settings = study.network(study.supervisor).model_copy(update={"outputs": "all_imagenet"})
    results = Path("results", study.name)
    weights = results / "classifiers" / "reference" / f"{study.supervisor}.safetensors"
    with tempfile.TemporaryDirectory() as place:
        image_settings = ImageSettings(folder=folder, size=study.images.size)
        photographs = dataset.training_images(image_settings, Path(place) / "photographs.npy")
        published = classifiers.build(settings, photographs.classes, weights)
        network = classifiers.frozen(published, photographs.images)
        by_lens: dict[str, dict[int, torch.Tensor]] = {}
        for lens, seed in [(SHARP, study.seeds[0]), *product(lenses, study.seeds)]:
            camera = None
            if lens != SHARP:
                name = "psf_diffraction" if study.capture_of(lens).diffraction else "psf"
                psfs = results / "lenses" / lens / f"seed{seed}" / f"{name}.safetensors"
                if not psfs.exists():
                    continue
                camera = PsfCamera.of(study.capture_of(lens), *psf_files.read(psfs))
            pipeline = evaluation.CapturePipeline(camera)
            correct = evaluation.evaluate([network], photographs, pipeline, f"{lens}, seed {seed}").correct[0]
            by_lens.setdefault(lens, {})[seed] = 100 * correct.double().mean(0)
    return {
        lens: pandas.DataFrame({seed: values.numpy() for seed, values in by_lens[lens].items()}) for lens in by_lens
    }


def rows(by_lens: dict[str, pandas.DataFrame], first: str) -> list[tuple]:
    """Rows of the table: accuracy, standard deviation over seeds, advantage of the lens of the design `first`."""
    table = []
    for lens, values in by_lens.items():
        elements, _, design = lens.partition("-")
        best, advantage = by_lens.get(f"{elements}-{first}"), ""
        if best is not None and design != first:
            seeds = [seed for seed in values if seed in best]
            difference = (best[seeds] - values[seeds]).to_numpy()
            low, high = bootstrap.interval(
                bootstrap.resampled_over_seeds(bootstrap.resampled_means(difference), difference.mean(0))
            )
            advantage = f"{difference.mean():+.1f} ({low:+.1f} to {high:+.1f})"
        spread = f" ± {values.mean().std(ddof=1):.1f}" if values.shape[1] > 1 else ""
        table.append((lens, values.shape[1], f"{numpy.mean(values.to_numpy()):.1f}{spread}", advantage))
    return table


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("study", help="file of a study that has run")
    parser.add_argument("folder", type=Path, help="photographs, a folder per class")
    parser.add_argument("--designs", nargs="+", default=DESIGNS)
    options = parser.parse_args(argv)
    study = loading.load(options.study)
    lenses = [name for name, lens in (study.lenses | study.variants).items() if lens.design_name in options.designs]
    by_lens = accuracies(study, options.folder, lenses)
    count = len(by_lens[SHARP])
    title = f"{study.name}: zero-shot accuracy of {study.supervisor} on {count} photographs of {options.folder.name}"
    columns = ("lens", "seeds", "accuracy [%]", f"advantage of {options.designs[0]} [points]")
    report(title, columns, rows(by_lens, options.designs[0]), options.save)


if __name__ == "__main__":
    main()
