"""Small studies for tests, changes of them, and the files of their results."""

from pathlib import Path

from tasklens.materials.catalogues import PLASTICS
from tasklens.study.report.measurements import Measurements

TASK_TRAINING = {"epochs": 1, "learning_rate": 1e-3, "batch_size": 4}
SEGMENTATION = {"kind": "segmentation", "model": "lraspp_mobilenet_v3_large"}
MASKS = {"kind": "instance_segmentation", "backbone": "resnet18", "channels": 8}
BOXES = MASKS | {"kind": "detection"}


def studies_we_ship() -> dict[str, Path]:
    """The file of each study of config/ by its name."""
    return {path.name: path for path in sorted((Path(__file__).parents[1] / "config").glob("*.yaml"))}


def tiny_study() -> dict:
    """A study with one lens of every method, of a size that runs in seconds."""
    rates = {"curvature": 1e-2, "thickness": 5e-3, "alpha_4": 1e-2}
    together = {"optimizer": "adamw", "steps": 2, "network_learning_rate": 1e-5}
    return {
        "format": 3,
        "name": "tiny",
        "seeds": [0],
        "images": {"size": 16, "train": 40, "minival": 10, "test": 20},
        "spec": {"kernel_size": 11},
        "evaluation_rays": 64,
        "elements": {"singlet": ["COC"]},
        "supervisor": "small",
        "classifiers": {
            "small": {"model": "test_resnet", "training": {"epochs": 1, "learning_rate": 1e-3, "batch_size": 20}},
            "other": {"model": "test_vit", "arguments": {"img_size": 16, "patch_size": 8}, "weights": "/nowhere"},
        },
        "designs": {
            "tasklens": {
                "batch_size": 2,
                "rays": 16,
                "descents": [
                    {"steps": 2, "lenses": 2, "pixels": [20, 5]},
                    {"steps": 2, "pixels": [5, 1]},
                    {"steps": 1},
                    {"optimizer": "adamw", "steps": 1, "network_learning_rate": 1e-5},
                ],
            },
            "image_error": {
                "batch_size": 2,
                "rays": 16,
                "descents": [
                    {"steps": 2, "pixels": [20, 5], "criterion": "log_image_error"},
                    {"steps": 2, "pixels": [5, 1], "criterion": "image_error"},
                ],
            },
            "imaging1": {
                "rays": 16,
                "descents": [{"optimizer": "adamw", "criterion": "spot", "steps": 3, "learning_rates": rates}],
            },
            "imaging2": {"method": "least_squares", "starts": 3, "evaluations": 6},
            "end_to_end_from_imaging": {"start": "best_imaging", "batch_size": 2, "descents": [together]},
            "end_to_end_from_flat": {"batch_size": 2, "descents": [together]},
        },
        "fine_tuning": {"epochs": 1, "learning_rate": 1e-3, "batch_size": 20},
        "restoration": {"width": 4, "encoder": [1], "middle": 1, "decoder": [1], "steps": 2, "batch_size": 4},
    }


def one_lens(**changes) -> dict:
    """The tiny study with its design by spots alone, and other changes."""
    study = tiny_study()
    return study | {"designs": {"imaging1": study["designs"]["imaging1"]}} | changes


def with_imported(**catalogues) -> dict:
    """The tiny study and an imported lens; a study does not look into its file."""
    return changed(tiny_study(), "imported.phone", {"elements": "quadruplet", "file": str(PLASTICS), **catalogues})


def changed(study, key: str, value):
    """A copy of a study's mapping with the value at a dotted key replaced or added; numbers index lists."""
    head, _, rest = key.partition(".")
    if isinstance(study, list):
        items = list(study)
        items[int(head)] = changed(items[int(head)], rest, value) if rest else value
        return items
    return study | {head: changed(study.get(head, {}), rest, value) if rest else value}


def result(study: str, path: str) -> Path:
    """A file of a study below its folder of results."""
    return Path("results", study, path)


def measurement(study: str, lens: str, measured_name: str, seed: int = 0, kind: str = "") -> Path:
    """A CSV file of metrics, or of another kind such as `-predictions`."""
    return result(study, f"metrics/{lens}/seed{seed}/{measured_name}{kind}.csv")


def lens_file(study: str, lens: str, seed: int = 0, name: str = "lens.yaml") -> Path:
    """The prescription of a lens, or another file beside it."""
    return result(study, f"lenses/{lens}/seed{seed}/{name}")


def measurements_of(study: str, contents) -> Measurements:
    """Files of the measurements that a table or the claims need."""
    lenses = {key: lens_file(study, *key) for key in contents.lens_keys}
    metrics, predictions, frozen = (
        {key: measurement(study, *key, kind) for key in contents.measured_keys}
        for kind in ("", "-predictions", "-frozen")
    )
    frozen_files = {key: frozen[key] for key in getattr(contents, "frozen_keys", [])}
    return Measurements(lenses, metrics, predictions, frozen_files)
