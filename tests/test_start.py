"""Starts and variables of designs, and their schedules."""

import pytest
import torch
from designs import LIMITS, SPEC, tiny_network
from examples import f64, materials, random_lens, write
from studies import changed, tiny_study

from tasklens.design import descents, methods
from tasklens.design.constraints import manufacturing_margins, worst_margin
from tasklens.design.optimizers import cosine
from tasklens.design.start import flat
from tasklens.design.variables import Variables, parameter_groups
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.io import prescription
from tasklens.runtime.checkpoints import NO_CHECKPOINT
from tasklens.settings.design_settings import LearningRates
from tasklens.settings.specification import Constraints, Spec
from tasklens.study.jobs import design_lens as design_job
from tasklens.study.loading import parse
from tasklens.study.table_contents import lens_design


@pytest.mark.parametrize("elements", [1, 4])
def test_flat_start_keeps_the_limits_and_has_no_power(elements):
    """Plane plates that can be made, a stop of EFL / (2 F), nothing bent."""
    lens = flat(materials("COC") * elements, SPEC, LIMITS)
    assert float(paraxial(lens, 0.5893).power) == 0
    assert float(lens.semi_diameter[lens.stop]) == pytest.approx(SPEC.efl_mm / (2 * SPEC.f_number), rel=1e-15)
    margins = manufacturing_margins(lens, LIMITS, torch.full_like(lens.thickness, 1.5))
    del margins["max_centre_thickness"]  # few plates fill the track with thick glass
    assert worst_margin(margins)[1] >= 0


def test_a_short_flat_start_has_less_space_behind_its_plates():
    """0.36 focal lengths from stop to sensor: the plates keep their least thickness."""
    spec, limits = Spec(field_of_view_deg=40.0, kernel_size=11), Constraints(flat_track=0.36)
    lens = flat(materials("COC"), spec, limits)
    assert float(lens.thickness[1]) == pytest.approx(limits.min_centre_thickness)
    assert limits.min_back_focus < float(lens.thickness[-1]) < 0.35 * spec.efl_mm
    assert float(lens.thickness.sum()) == pytest.approx(0.36 * spec.efl_mm)


def test_variables_there_and_back():
    """Assembling what was taken out changes nothing; assembling other values changes these and no others."""
    lens = random_lens(0)
    variables = Variables.plain(lens)
    same = variables.assemble(variables.values())
    for name in ("curvature", "conic", "alpha", "thickness", "semi_diameter"):
        assert torch.equal(getattr(same, name), getattr(lens, name)), name
    values = {name: torch.full_like(v, 0.1 * k) for k, (name, v) in enumerate(variables.values().items(), 1)}
    again = Variables.plain(variables.assemble(values)).values()
    assert all(torch.equal(values[name], again[name]) for name in values)
    other = variables.assemble(values)
    assert torch.equal(other.alpha[:, 0], lens.alpha[:, 0]) and torch.equal(other.conic, lens.conic)
    assert other.thickness[0] == lens.thickness[0] and other.curvature[0] == lens.curvature[0]
    partial = variables.assemble({"curvature": values["curvature"]})
    assert torch.equal(partial.thickness, lens.thickness) and torch.equal(partial.alpha, lens.alpha)


def test_normalised_variables_are_slopes_at_the_radius_that_light_uses():
    """alpha_2j R^(2j - 1) is 1 / (2j) of the slope that the term has at R; taking out and putting in is exact."""
    lens, used = random_lens(0), f64([0.3, 0.4, 0.7, 1.1, 1.9])
    variables = Variables(lens, used)
    for order in (4, 6, 8, 10):
        r = used.clone().requires_grad_()
        slope = torch.autograd.grad((lens.alpha[:, order // 2 - 1] * r**order).sum(), r)[0]
        torch.testing.assert_close(variables.values()[f"alpha_{order}"], slope[1:] / order, rtol=1e-13, atol=0)
    torch.testing.assert_close(variables.assemble(variables.values()).alpha, lens.alpha, rtol=1e-14, atol=0)


def test_each_asphere_order_learns_more_slowly_by_one_factor():
    values = Variables.plain(random_lens(0)).values()
    groups = parameter_groups(values, LearningRates(curvature=1, thickness=2, alpha_4=3, decay=0.5))
    assert [group["lr"] for group in groups] == [1, 2, 3, 1.5, 0.75, 0.375]
    assert [group["params"][0] is value for group, value in zip(groups, values.values(), strict=True)] == [True] * 6


def test_cosine_schedule():
    """From 1 to the final fraction, their mean half-way, symmetric about it."""
    assert [cosine(x, 0.2) for x in (0, 0.5, 1, 2)] == pytest.approx([1, 0.6, 0.2, 0.2])
    assert cosine(0.3, 0.2) + cosine(0.7, 0.2) == pytest.approx(1.2)
    assert cosine(0.7, 1.0) == 1


@pytest.mark.parametrize("names, rate", [(["imaging1", "imaging2"], 1e-3), ("best_imaging", None)])
def test_a_design_begins_with_the_most_accurate_start(start, spot_lens, monkeypatch, names, rate):
    """With a trained network no other lens competes; with a frozen one the start remains if it is not improved."""
    joint = {"start": names, "descents": [{"steps": 1, "network_learning_rate": rate}]}
    study = changed(tiny_study(), "elements", {"doublet": ["COC", "OKP4"]})
    study = parse(changed(study, "designs.joint", joint))
    design_settings, calls = lens_design(study, "doublet-joint", 0), []

    def design(begin, candidates, *rest):
        calls.append((begin, candidates))
        raise Called

    starts = {"doublet-imaging1": start, "doublet-imaging2": spot_lens}
    monkeypatch.setattr(descents, "design", design)
    with pytest.raises(Called):
        methods.design(design_settings, tiny_network(), None, starts, dict(zip(starts, (60.0, 70.0), strict=True)))
    ((begin, candidates),) = calls
    assert torch.equal(begin.curvature, spot_lens.curvature)
    assert list(candidates) == ([] if rate else ["doublet-imaging2"])
    assert all(torch.equal(lens.curvature, spot_lens.curvature) for lens in candidates.values())


class Called(Exception):
    """Ends a design at its beginning."""


@pytest.mark.parametrize("names, start", [(["imaging1"], "even"), ("best_imaging", "uneven")])
def test_a_joint_descent_begins_with_no_lost_field(tmp_path, monkeypatch, names, start):
    """With the lens whose worst field is the best; end-to-end design, as in the paper, with the best mean."""
    lens, accuracies = flat(materials("COC"), Spec(), LIMITS), {"even": 9 * [60], "uneven": [*8 * [70], 10]}
    prescription.write(tmp_path / "lens.yaml", prescription.Prescription(lens), {})
    for name, values in accuracies.items():
        rows = [f"{field},minival_accuracy,{value}\n" for field, value in enumerate(values)]
        write(tmp_path / name, "field,metric,value\n" + "".join(rows))
    joint = {"start": names, "descents": [{"steps": 1, "network_learning_rate": 1e-3}]}
    design_settings = lens_design(parse(changed(tiny_study(), "designs.joint", joint)), "singlet-joint", 0)

    def design(settings, network, train, starts, accuracies, *rest):
        raise Called(max(starts, key=lambda name: accuracies[name]))

    monkeypatch.setattr(methods, "design", design)
    settings = design_settings.model_copy(update={"starts": tuple(accuracies)})
    starts, metrics = 2 * [tmp_path / "lens.yaml"], [tmp_path / name for name in accuracies]
    outputs = (tmp_path / name for name in ("out.yaml", "history.csv"))
    with pytest.raises(Called, match=f"^{start}$"):
        design_job.run(settings, [], None, [], starts, metrics, *outputs, NO_CHECKPOINT)
