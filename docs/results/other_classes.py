"""Read a study's lenses on photographs of other classes: `python docs/results/other_classes.py STUDY FOLDER`.

FOLDER has a folder per class of ImageNet, named by its WordNet id; no lens was designed with its photographs. The
supervisor of the study reads them among all thousand classes. The program reads results/STUDY in the current folder and
writes docs/results/STUDY/other_classes: accuracies, and the verdicts of the study's table 1 with the new answers.
Baselines are those of the study, chosen on its minival images.
"""

import argparse
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pandas

from tasklens.recognition import classifiers, dataset, evaluation
from tasklens.settings.image_settings import ImageSettings
from tasklens.settings.names import SHARP
from tasklens.study import loading
from tasklens.study.report import answers_file, verdicts
from tasklens.study.study import Study

FOLDER = Path(__file__).parent
Key = tuple[str, str, int]  # lens, classifier, seed


def answers(study: Study, results: Path, folder: Path, keys: list[Key]) -> Mapping[Key, pandas.DataFrame]:
    """Return the correct answers, a row per photograph and a column per field, of lenses and of the sharp images."""
    settings = study.classifier(study.supervisor).model_copy(update={"outputs": "all_imagenet"})
    with tempfile.TemporaryDirectory() as place:
        images = ImageSettings(folder=folder, size=study.images.size)
        photographs = dataset.training_images(images, Path(place) / "photographs.npy")
        weights = results / "classifiers" / "reference" / f"{study.supervisor}.safetensors"
        network = classifiers.frozen(classifiers.build(settings, photographs.classes, weights), photographs.images)
        labels = [photographs.classes[label] for label in photographs.labels]
        index = pandas.MultiIndex.from_arrays([range(len(labels)), labels], names=["image", "label"])
        frames = {}
        for lens, classifier, seed in keys:
            pipeline = evaluation.CapturePipeline()
            if lens != SHARP:
                path = results / "lenses" / lens / f"seed{seed}" / "psf.safetensors"
                capture = study.capture_of(lens)
                pipeline = evaluation.CapturePipeline.of(capture, path, "grading", photographs.device)
            correct = evaluation.evaluate(network, photographs, pipeline, f"{lens}, seed {seed}").correct
            frames[lens, classifier, seed] = pandas.DataFrame(correct.T.int().numpy(), index=index)
    return frames


def write(study: Study, results: Path, folder: Path, destination: Path) -> None:
    """Write the accuracies and verdicts of a study for other photographs."""
    claims, packed = answers_file.read(results / "tables" / "verdicts.npz")
    claims = claims.model_copy(update={"claims": tuple(claim for claim in claims.claims if claim.table == "table1")})
    sharp = (SHARP, study.supervisor, study.seeds[0])
    frames = answers(study, results, folder, [sharp, *claims.measured_keys])
    packed = replace(packed, answers=frames)
    destination.mkdir(parents=True, exist_ok=True)
    accuracies = [(lens, seed, 100 * frame.mean(axis=None)) for (lens, _, seed), frame in frames.items()]
    table = pandas.DataFrame(accuracies, columns=["lens", "seed", "accuracy"])
    table.to_csv(destination / "accuracies.csv", index=False)
    verdicts.collect(claims, packed).to_csv(destination / "verdicts.csv", index=False)
    answers_file.write(destination / "verdicts.npz", claims, packed)


def main() -> None:
    """Read the lenses of the study of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("study", metavar="STUDY")
    parser.add_argument("folder", metavar="FOLDER", type=Path)
    options = parser.parse_args()
    results = Path("results") / options.study
    write(loading.load(results / "study.yaml"), results, options.folder, FOLDER / options.study / "other_classes")


if __name__ == "__main__":
    main()
