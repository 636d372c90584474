"""A study trains networks for its tasks, designs lenses for them and has a table of them."""

from pathlib import Path

import pandas
import pytest
import torch
import yaml
from examples import read_rows
from rules import finish, job_of
from studies import BOXES, SEGMENTATION, TASK_TRAINING, changed, tiny_study

from tasklens.materials.catalogues import PLASTICS
from tasklens.optics.io import prescription
from tasklens.settings.task_settings import SceneSettings
from tasklens.study import claims, table_contents, task_jobs
from tasklens.study.jobs import render_scenes
from tasklens.study.loading import parse
from tasklens.study.report import task_table as report_tasks
from tasklens.study.run.outcome import outcome
from tasklens.study.study import StudyError


def test_numbers_of_the_table(tmp_path):
    """Means over fields and seeds, the worst field of the means over seeds, tasks in their order."""
    paths = {}
    for seed, gain in ((0, 0.0), (1, 10.0)):
        values = {(False, 0): 20.0, (False, 1): 30.0, (True, 0): 50.0, (True, 1): 40.0}
        common = {"elements": "doublet", "design": "d", "task": "z", "seed": seed, "metric": "miou"}
        rows = [
            common | {"field": field, "value": value + gain * tuned, "tuned": tuned}
            for (tuned, field), value in values.items()
        ]
        path = tmp_path / f"{seed}.csv"
        pandas.DataFrame(rows).to_csv(path, index=False)
        paths[task_jobs.TaskKey("doublet-d", "z", seed)] = path
    (row,) = report_tasks.collect(paths).to_dict("records")
    assert (row["frozen"], row["tuned"], row["worst_field"], row["seeds"]) == (25.0, 50.0, 45.0, 2)


def test_splits_have_other_images():
    splits, again = (render_scenes.splits(SceneSettings(size=32, train=3, test=3)) for _ in range(2))
    assert not torch.equal(splits["train"].images, splits["test"].images)
    assert torch.equal(again["test"].masks, splits["test"].masks)


def test_a_study_of_tasks(here):
    """Scenes, networks on sharp images, fine-tuning on captures, and the table; sharp images first."""
    networks = {"pixels": SEGMENTATION | {"training": TASK_TRAINING, "fine_tuning": TASK_TRAINING}}
    section = {"scenes": {"size": 32, "train": 8, "test": 4}, "designs": ["imaging1"], "networks": networks}
    study = parse(tiny_study() | {"tasks": section})
    finish("scenes", study)
    finish("images", study)
    for rule in ("design", "psfs"):
        finish(rule, study, lens="singlet-imaging1", seed=0)
    finish("task_reference", study, task="pixels")
    for lens in ("sharp", "singlet-imaging1"):
        paths = finish("task_fine_tune", study, lens=lens, task="pixels", seed=0)
        rows = read_rows(paths.metrics)
        assert {row["field"] for row in rows} == ({"0"} if lens == "sharp" else set(map(str, range(16))))
        assert {row["tuned"] for row in rows} == {"True", "False"}
        assert outcome("task_fine_tune", [*map(str, vars(paths).values())], Path("no.log")).startswith("miou")
    paths = finish("tasks_table", study)
    rows = read_rows(paths.csv)
    assert [(row["task"], row["design"]) for row in rows] == [("pixels", "reference"), ("pixels", "imaging1")]
    assert "Other tasks" in paths.md.read_text()


def test_a_study_without_tasks_has_no_table():
    with pytest.raises(StudyError, match=r"tasks\.networks: expected a task"):
        task_jobs.tasks(parse(tiny_study()))


TASK_DRIVEN = {
    "start": ["imaging1"],
    "task": "boxes",
    "batch_size": 2,
    "rays": 16,
    "augment": False,
    "micro_batch": 18,
    "descents": [{"steps": 2, "centre": "chief_ray"}],
}


def with_tasks(**design) -> dict:
    networks = {"boxes": BOXES | {"training": TASK_TRAINING, "fine_tuning": TASK_TRAINING}}
    study = tiny_study() | {"tasks": {"scenes": {"size": 32, "train": 8, "test": 4}, "networks": networks}}
    return changed(study, "designs.for_boxes", TASK_DRIVEN | design)


@pytest.mark.slow
def test_a_lens_is_designed_for_detection(here, few_rays):
    """By its frozen network, on images with objects, from an imaging lens; it appears only in the tasks' table."""
    study = parse(with_tasks())
    finish("images", study)
    finish("scenes", study)
    finish("task_reference", study, task="boxes")
    start = finish("design", study, lens="singlet-imaging1", seed=0)
    final = finish("design", study, lens="singlet-for_boxes", seed=0)
    lenses = [prescription.read(paths.lens)[0].lens for paths in (start, final)]
    assert not torch.equal(lenses[0].curvature, lenses[1].curvature)
    assert yaml.safe_load(Path(final.lens).read_text())["origin"]["start"] == "singlet-imaging1"
    assert all("singlet-for_boxes" not in table_contents.table(study, name).lenses for name in study.tables)
    assert task_jobs.tasks(study).lenses[-1] == "singlet-for_boxes"
    assert not any("for_boxes" in lens for claim in claims.claims(study).claims for lens in claim.lenses)


def test_other_fine_tuning_of_a_task_designs_no_lens_again():
    """The frozen network of the design has none."""
    study, other = (parse(changed(with_tasks(), "tasks.networks.boxes.fine_tuning.epochs", n)) for n in (1, 2))
    lens = {"lens": "singlet-for_boxes", "seed": 0}
    for rule, wildcards, same in (("design", lens, True), ("task_fine_tune", lens | {"task": "boxes"}, False)):
        before, after = (job_of(rule, s, **wildcards).settings for s in (study, other))
        assert (before == after) == same


@pytest.mark.parametrize(
    "change, words",
    [
        ({"task": "depth"}, "designs.for_boxes.task: 'depth' is not one of `tasks.networks`: boxes"),
        ({"batch_norm": "batch"}, "expected a frozen network, `batch_norm: stored`"),
        ({"augment": True}, "since masks fit only unchanged images"),
        ({"descents": [{"steps": 2, "size": 16}]}, "since masks fit only unchanged images"),
    ],
)
def test_designs_that_do_not_fit_their_task(change, words):
    with pytest.raises(StudyError, match=words):
        parse(with_tasks(**change))


def test_variants_and_imported_lenses_fit_the_tasks():
    """Variants name their tasks as designs do; the window of an imported lens is smaller than the scenes."""
    variants = {"elements": "singlet", "design": "for_boxes", "variants": {"deep": {"task": "depth"}}}
    with pytest.raises(StudyError, match=r"ablations\.mine\.variants\.deep\.task: 'depth' is not one of"):
        parse(changed(with_tasks(), "ablations.mine", variants))
    phone = {"elements": "phone", "file": str(PLASTICS), "spec": {"kernel_size": 65}}
    study = changed(changed(with_tasks(), "images.size", 64), "imported.phone", phone)
    with pytest.raises(StudyError, match=r"imported\.phone: half of its kernel_size = 65 .* tasks\.scenes\.size = 32"):
        parse(study)
