"""Figure 4: frames through all task-driven lenses and the best imaging lens, and captures chosen by a stated rule."""

import json
import shutil
from pathlib import Path

import numpy
import pandas
import pytest
import torch
from examples import HEADLINE, write
from PIL import Image
from rules import finish, outputs
from studies import tiny_study

from tasklens.optics.io import psf_files
from tasklens.optics.view import view_of_spec
from tasklens.settings.specification import Spec
from tasklens.study.jobs import frames as frames_job
from tasklens.study.loading import parse

SHAPE = 108, 192
IMAGES, SIDE, FIELDS, HALFWAY = 8, 16, 16, 5
PSFS = 4 * FIELDS  # those that images take in turns
TASK, JOINT, BEST, OTHER = "doublet-tasklens", "doublet-tasklens_joint", "doublet-imaging2", "doublet-imaging3"
CORRECT = {  # halfway to the corner, in file order
    TASK: [1, 0, 1, 0, 1, 1, 0, 0],
    JOINT: [1, 1, 0, 1, 1, 1, 0, 0],
    BEST: [1, 0, 0, 1, 0, 1, 1, 0],
    OTHER: [0] * IMAGES,
}


def with_parent(path: Path) -> Path:
    """The path, with the folder of its file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


@pytest.fixture
def study(here, monkeypatch):
    """Doublets of the headline study with planted predictions, and random images."""
    monkeypatch.setattr(frames_job, "_SHAPE", SHAPE)
    tiny = tiny_study()
    task = tiny["designs"]["tasklens"]
    joint = {"start": ["imaging2"], "batch_size": 2, "rays": 16}
    joint |= {"descents": [task["descents"][2] | {"network_learning_rate": 1e-4}]}
    least = {"method": "least_squares", "starts": 3, "evaluations": 6}
    designs = {"tasklens": task, "tasklens_joint": joint, "imaging2": least, "imaging3": least}
    keys = {"elements": {"doublet": ["COC", "OKP4"]}, "designs": designs}
    study = parse(tiny | keys)
    images = numpy.random.default_rng(0).integers(0, 256, (IMAGES, 3, SIDE, SIDE), dtype=numpy.uint8)
    numpy.save(with_parent(outputs("images", study).test), images)
    labels = {"classes": ["cat", "dog"], "labels": [0, 1] * (IMAGES // 2)}
    write(outputs("images", study).test_labels, json.dumps(labels))
    for lens, correct in CORRECT.items():
        shutil.copy(HEADLINE / f"{lens}.yaml", with_parent(outputs("design", study, lens=lens, seed=0).lens))
        psf = torch.zeros(PSFS, 3, 5, 5)
        psf[..., 2, 2] = 1
        path = outputs("psfs", study, lens=lens, seed=0).psf
        notes = {"fields_mm": PSFS * [[0, 0]]}
        psf_files.write(path, psf, torch.ones(PSFS), {"grading": (0, PSFS, 4)}, notes)
        tuned = outputs("fine_tune", study, lens=lens, measured_name="small", seed=0)
        columns = {f"field{k}": correct if k == HALFWAY else [0] * IMAGES for k in range(FIELDS)}
        rows = {"image": range(IMAGES), "label": ["cat", "dog"] * (IMAGES // 2)} | columns
        write(tuned.predictions, pandas.DataFrame(rows).to_csv(index=False))
        write(tuned.metrics, f"metric,field,value\nminival_accuracy,0,{80 if lens == BEST else 10}\n")
    return study


def test_every_task_driven_lens_stands_beside_the_best_imaging_lens(study, monkeypatch):
    """Columns and captures follow the rule, frames have the sensor's pixels, and the file exists."""
    arguments, draw = {}, frames_job.draw

    def drawn(path, title, shown, answered, rule):
        arguments.update(title=title, shown=shown, answered=answered, rule=rule)
        draw(path, title, shown, answered, rule)

    monkeypatch.setattr(frames_job, "draw", drawn)
    finish("frames", study, elements="doublet", seed=0)
    assert arguments["shown"]
    for captures in arguments["shown"].values():
        assert list(captures) == ["sharp", TASK, JOINT, BEST]
        assert all(capture.shape == (3, *SHAPE) for capture in captures.values())
        blurred = [capture.diff(dim=2).abs().mean() for capture in captures.values()]
        assert max(blurred[1:]) < 0.9 * blurred[0]  # an image through a lens has less contrast from pixel to pixel
    only_task, only_best = arguments["answered"]
    captions = [{column: caption for column, (caption, _) in row.items()} for row in (only_task, only_best)]
    no, yes = "not recognised", "recognised"
    assert captions[0] == {"sharp": "test image 2, cat", TASK: yes, JOINT: no, BEST: no}
    assert captions[1] == {"sharp": "test image 3, dog", TASK: no, JOINT: yes, BEST: yes}
    sharp = only_task["sharp"][1]
    assert all(torch.allclose(capture, sharp, atol=1e-5) for _, capture in only_task.values())  # point PSFs
    assert f"network of {TASK} " in arguments["rule"] and f"that of {BEST} " in arguments["rule"]
    with Image.open(outputs("frames", study, elements="doublet", seed=0).figure) as image:
        assert image.width > 3 * image.height / 4


def test_networks_that_agree_leave_the_frames_alone(study, monkeypatch):
    answers = []
    monkeypatch.setattr(frames_job, "draw", lambda path, title, shown, answer, rule: answers.append(answer))
    predictions = [outputs("fine_tune", study, lens=n, measured_name="small", seed=0).predictions for n in (TASK, BEST)]
    shutil.copy(*predictions)
    finish("frames", study, elements="doublet", seed=0)
    assert answers == [[]]


@pytest.mark.parametrize("pitch, shape", [(1.8, (1080, 1920)), (0.9, (1080, 1920)), (3.6, (544, 968))])
def test_a_frame_has_no_more_pixels_than_the_sensor(pitch, shape):
    """4 mm on the diagonal: 1089 x 1937 pixels of 1.8 um, a quarter as many of 3.6 um."""
    assert frames_job._frame_shape(view_of_spec(Spec(pixel_pitch_um=pitch))) == shape
