"""Settings may change how a design method works, but not which method it is."""

from typing import get_args

import pytest
import torch
from examples import small_network
from rules import ROOT
from studies import changed, tiny_study

import tasklens
from tasklens.runtime.errors import InputError
from tasklens.settings.design_methods import methods
from tasklens.settings.design_settings import CriterionName
from tasklens.settings.lens_settings import TRAINING, lens_settings, with_starts
from tasklens.study.loading import load, parse
from tasklens.study.study import StudyError


def designed(method: str, settings: dict):
    network = small_network(0) if method in ("task", *TRAINING) else None
    return lens_settings(method, with_starts(method, settings, None), 51, None, network)


@pytest.mark.parametrize("method", [name for name in methods() if name != "least_squares"])
@pytest.mark.parametrize("criterion", get_args(CriterionName))
@pytest.mark.parametrize("rate", [None, 1e-3])
@pytest.mark.parametrize("form", ["list", "number"])
def test_a_method_keeps_its_criterion_and_its_use_of_the_network(method, criterion, rate, form):
    """Every criterion and network learning rate, in all forms of settings: accepted if they are those of the method."""
    own = methods()[method]["descents"][-1]
    change = {"criterion": criterion} | ({} if rate is None else {"network_learning_rate": rate})
    descents = [{"steps": 2, "criterion": "contrast"}, {"steps": 2, **change}] if form == "list" else {"0": change}
    settings = {"start": ["least_squares"], "descents": descents}
    trains = rate is not None or (form == "number" and "network_learning_rate" in own)
    kept = criterion == own.get("criterion", "task") and trains == (method in TRAINING)
    if kept:
        assert designed(method, settings).designs[method].descents[-1].criterion == criterion
    else:
        with pytest.raises(InputError, match=f"{method}|network_learning_rate"):
            designed(method, settings)


def test_a_descent_before_the_last_brings_no_network_into_a_method_without_one():
    """Other criteria of image quality may come first, and a frozen network before it is trained."""
    last = {"steps": 2, "criterion": "correlation"}
    for first in ("spot", "log_image_error"):
        designed("correlation", {"start": "flat", "descents": [{"steps": 2, "criterion": first}, last]})
    with pytest.raises(InputError, match="method correlation: expected descents without a network"):
        designed("correlation", {"start": "flat", "descents": [{"steps": 2, "criterion": "task"}, last]})
    designed("joint", {"start": "flat", "descents": [{"steps": 2}, {"steps": 2, "network_learning_rate": 1e-3}]})
    for descents in (
        [{"steps": 2, "network_learning_rate": 1e-3}, {"steps": 2}],
        {"0": {"network_learning_rate": None, "final": 0.1}},
    ):
        with pytest.raises(InputError, match="method joint: expected a network_learning_rate in its last descent"):
            designed("joint", {"start": "flat", "descents": descents})
    with pytest.raises(InputError, match="method least_squares: expected its own settings, got `method: descents`"):
        designed("least_squares", {"method": "descents", "descents": [{"steps": 2, "criterion": "spot"}]})


@pytest.mark.parametrize("side, name", [(64, "config"), (224, "photographs")])
def test_from_flat_plates_a_design_has_the_schedule_of_the_studies(side, name):
    """The design `tasklens` for such images; criteria of image quality have the same steps, for their comparison."""
    own = load(ROOT / "config" / f"{name}.yaml").designs["tasklens"]
    images = {"size": side, "train": 10, "minival": 2, "test": 10}
    for method, criterion in (("task", "task"), ("correlation", "correlation")):
        network, baselines = (small_network(0), ["log_image_error"]) if method == "task" else (None, [])
        keys = with_starts(method, {"start": "flat"}, images)
        result = lens_settings(method, keys, 51, images, network, baselines)
        for design in result.designs.values():
            assert [part.steps for part in design.descents] == [part.steps for part in own.descents]
        assert {part.criterion for part in result.designs[method].descents} == {criterion}
        if method == "task":
            assert result.designs["task"] == own and list(result.designs) == ["log_image_error", "task"]


def test_methods_without_a_schedule_from_flat_plates_refuse_them():
    """Unless they get descents. Rendered textures have their schedule whatever the window."""
    for method in ("joint", "contrast", "least_squares"):
        with pytest.raises(InputError, match=f"method {method}: has no schedule from flat plates; choose task, "):
            designed(method, {"start": "flat"})
    wide = lens_settings("correlation", with_starts("correlation", {"start": "flat"}, None), 151, None, None)
    assert wide.designs["correlation"].descents[0].size is None


def test_a_study_may_name_a_method_as_its_design():
    """It is the design of `tasklens design`; a study that extends this one may change it."""
    named = parse(changed(tiny_study(), "designs.imaging1", "spot"))
    written = parse(changed(tiny_study(), "designs.imaging1", methods()["spot"]))
    assert named.designs["imaging1"] == written.designs["imaging1"]
    with pytest.raises(StudyError, match=r"designs\.imaging1"):
        parse(changed(tiny_study(), "designs.imaging1", "spots"))


def test_flat_is_a_start_in_python(few_rays):
    """The lens starts from plates, and from no other lens."""
    data = [(torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(k)), k % 2) for k in range(12)]
    settings = {"descents": [{"steps": 2, "pixels": [20, 20]}], "batch_size": 2}
    options = {"images": data, "network": small_network(0), "start": "flat", "settings": settings, "kernel_size": 15}
    _, _, notes = tasklens.design_lens("task", loss=torch.nn.functional.cross_entropy, **options)
    assert notes["origin"]["start"] == "flat" and "candidate_losses" not in notes["origin"]
