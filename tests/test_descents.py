"""One descent for all methods: steps of the earlier classes, consistent keys, and penalties."""

import math
from dataclasses import replace

import pytest
import torch
from designs import LEARNING_RATES, LIMITS, VIEW, problem, tiny_network
from examples import f64, make_lens, materials
from studies import changed, tiny_study

from tasklens.design import least_squares, methods
from tasklens.design.constraints import _INCIDENT, incidence_penalty
from tasklens.design.criteria import JointTaskLoss, TaskLoss
from tasklens.design.descent import Descent
from tasklens.design.image_quality import SpotRadius
from tasklens.design.objective import Objective
from tasklens.design.optimizers import AdamWOptimizer
from tasklens.design.problem import Problem
from tasklens.design.start import flat
from tasklens.fields import PAPER
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, rms_spot_radius, trace_fields, trace_fields_full
from tasklens.optics.io import prescription
from tasklens.optics.view import View, view_of_spec
from tasklens.runtime.errors import InputError
from tasklens.settings.design_settings import DescentSettings, GradientDesignSettings, LeastSquaresSettings
from tasklens.settings.layers import merged_settings
from tasklens.settings.specification import Spec
from tasklens.study.loading import parse
from tasklens.study.study import StudyError
from tasklens.study.table_contents import lens_design

COARSE = {"steps": 4, "pixels": (20, 10), "step_size": 0.6, "damping": 0.5}
COLD = {"optimizer": "adamw", "steps": 4, "learning_rates": LEARNING_RATES}
COLD |= {"pixels": (20, 1), "duration": 0.5, "stop_scale": 0.3}
TRAINED = {"network_learning_rate": 1e-2}


# Losses of the first four steps of the earlier classes at the paper's nine fields, at commit c0538e9; for the spot
# descent the mean RMS spot radius [um]. One feels limits, which are at all radii now.
@pytest.mark.parametrize(
    "settings, expected",
    [
        (COARSE, [1.1576279799, 1.0571862989, 1.1006794506, 1.1361806658]),
        (COARSE | TRAINED, [1.0087804264, 1.4160249631, 0.8149189949, 0.9666303396]),
        (COLD | TRAINED, [1.0117445257, 1.3945707745, 0.8159310818, 0.9726718664]),
        (
            COLD | {"criterion": "spot", "pixels": (1, 1), "betas": (0.9, 0.99)},
            [110.6445735, 176.6516679, 251.6419327, 237.6091768],
        ),
    ],
)
def test_first_steps_have_the_recorded_losses(settings, expected):
    part = DescentSettings(**settings)
    plates = flat(materials("COC", "OKP4"), Spec(kernel_size=11), LIMITS)
    criterion = SpotRadius() if part.criterion == "spot" else TaskLoss(tiny_network().eval().requires_grad_(False))
    if part.trains_network:
        criterion = JointTaskLoss(tiny_network(), 1e-2, 4, 0.1)
    design_problem = replace(problem(), seed=0, fields=PAPER)
    design = GradientDesignSettings(descents=[part], batch_size=4, rays=32)
    descent = Descent(plates, Objective(criterion, design_problem, None, False, 36), design, part, seed=0)
    losses = []
    for step in range(1, 5):
        numbers, spots = descent.step(step)
        losses.append(1e3 * float(spots.mean()) if part.criterion == "spot" else numbers["loss"])
    assert losses == pytest.approx(expected, rel=1e-5)


def test_final_learning_rates_count_before_the_end_or_with_a_trained_network():
    assert DescentSettings(steps=9, final=0.02, duration=0.7).final == 0.02
    assert DescentSettings(steps=9, final=0.02, network_learning_rate=1e-4).final == 0.02


def test_an_entry_of_a_list_is_changed_by_its_number():
    below = {"descents": [{"steps": 1, "damping": 0.5}, {"steps": 2}]}
    above = {"descents": {"1": {"steps": 3}}}
    assert merged_settings(below, above) == {"descents": [{"steps": 1, "damping": 0.5}, {"steps": 3}]}
    assert merged_settings(below, {"descents": [{"steps": 4}]}) == {"descents": [{"steps": 4}]}
    with pytest.raises(InputError, match=r"designs\.mine\.descents\.2: there is no such entry; expected 0 to 1"):
        merged_settings({"designs": {"mine": below}}, {"designs": {"mine": {"descents": {"2": {"steps": 3}}}}})


# ---- angles of incidence


def wedge(curvature=0.0):
    """A stop and one element, and a view of one field at 30 degrees."""
    lens = make_lens([0, curvature, 0], [0.1, 0.5, 1.0], ("air", "COC", "air"), semi_diameter=[0.2, *[torch.inf] * 2])
    efl = 2.0
    return lens, View(f64([[0.0, efl * math.tan(math.radians(30))]]), efl, (0.6563, 0.5893, 0.4861), 1.8, 11)


@pytest.mark.parametrize("stop, rel", [(0, 1e-9), (2, 1e-6)])
def test_incidence_on_a_plate_is_the_angle_of_the_field(stop, rel):
    """30 degrees on the front, in the glass asin(sin 30 / n): every ray exceeds 15 degrees by the difference.

    A stop behind the plate, which is thin and far from focus, passes the same chief and marginal rays.
    """
    lens, view = wedge()
    lens = replace(lens, stop=stop, semi_diameter=lens.semi_diameter.roll(stop))
    index = float(lens.refractive_indices((0.5893,))[2, 0])
    inside = math.asin(0.5 / index)
    excess = [math.radians(30) - math.radians(15), inside - math.radians(15)]
    assert float(incidence_penalty(lens, view, 15.0)) == pytest.approx(sum(e * e for e in excess), rel=rel)
    assert float(incidence_penalty(lens, view, 31.0)) == 0


def test_incidence_on_a_sphere():
    """The angle between a ray and the radius at its point, for all penalised rays."""
    lens, view = wedge(curvature=-0.4)
    _, (rays, points, _) = trace_fields_full(lens, view.in_reference(), _INCIDENT)
    normal = torch.stack([points.x, points.y, points.z + 1 / 0.4]) * 0.4
    angle = torch.acos((normal * torch.stack([rays.l, rays.m, rays.n])).sum(0).abs())
    front = (angle - math.radians(20)).clamp(min=0).square().mean()
    names = ("curvature", "conic", "alpha", "thickness", "semi_diameter", "media")
    alone = replace(lens, **{name: getattr(lens, name)[:2] for name in names})
    assert float(front) > 1e-3
    assert float(incidence_penalty(alone, view, 20.0)) == pytest.approx(float(front), rel=1e-9)


# ---- starts


def with_start(file, start):
    """The tiny study with a design that begins with an imported singlet."""
    study = changed(tiny_study(), "imported.phone", {"elements": "singlet", "file": str(file)})
    # Wide limits: otherwise the repair would take most of the time.
    study["constraints"] = {"efl_tolerance": 0.9, "distortion": 0.9, "max_slope": 3.0, "max_track": 9.0}
    part = {"steps": 2, "criterion": "log_image_error", "pixels": [5, 5]}
    return changed(study, "designs.mine", {"start": start, "batch_size": 2, "rays": 16, "descents": [part]})


@pytest.mark.parametrize("keep", [True, False])
def test_a_design_begins_with_a_lens_from_a_file(tmp_path, start, few_rays, keep):
    """Shape and materials are from the file; missing aspheric coefficients are zero, and free.

    Clear apertures are kept, also none; otherwise they are those of the lit part of the new lens.
    """
    apertures = start.semi_diameter.clone()
    apertures[1], apertures[2] = torch.inf, 0.9
    given = replace(start, alpha=start.alpha[:, :0], semi_diameter=apertures)
    prescription.write(tmp_path / "phone.yaml", prescription.Prescription(given), {})
    study = changed(with_start(tmp_path / "phone.yaml", ["phone"]), "designs.mine.keep_apertures", keep)
    settings = lens_design(parse(study), "singlet-mine", 0)
    assert settings.starts == ("singlet-phone",) and not settings.entry.by_accuracy
    lens, notes, *_ = methods.design(settings, None, problem().dataset, {"singlet-phone": given}, {})
    origin = notes["origin"]
    assert origin["start"] == "singlet-phone" and [*origin["candidate_losses"]] == ["singlet-phone"]
    assert lens.media == given.media and lens.alpha.shape[1] == 5
    assert torch.equal(lens.semi_diameter, apertures) == keep and (keep or lens.semi_diameter.isfinite().all())


def test_designs_that_begin_with_each_other_are_refused():
    study = changed(tiny_study(), "designs.image_error.start", ["sharp"])
    study = changed(study, "designs.sharp", study["designs"]["image_error"] | {"start": ["image_error"]})
    with pytest.raises(StudyError, match="image_error would start from itself, through sharp"):
        parse(study)
    own = changed(tiny_study(), "designs.image_error.start", "best_imaging")  # it is an imaging design itself
    with pytest.raises(StudyError, match=r"designs\.image_error\.start: image_error would start from itself"):
        parse(own)


def test_least_squares_stops_at_a_spot():
    """At a mean spot of 12 um over the fields of the merit function, which are close to those of the view."""
    settings = LeastSquaresSettings(method="least_squares", starts=20, evaluations=700, spot_um={"doublet": 12.0})
    assert settings.of_elements("triplet").spot_um is None
    view, plates = view_of_spec(Spec()), flat(materials("COC", "OKP4"), Spec(), LIMITS)
    lens, history = least_squares.design(plates, Problem(view, LIMITS, 0), settings.of_elements("doublet"))
    rays = trace_fields(lens, view, sobol_disc(512, 0))
    assert 1e3 * float(rms_spot_radius(rays, centroid(rays)).mean()) == pytest.approx(12, rel=0.1)
    assert all(row["rms_um"] > 10 for row in history)


def test_a_lens_far_outside_its_limits_is_the_best_only_if_all_are(start, monkeypatch):
    """Its loss is smaller, but its repair would change it; of two lenses far outside, the loss decides."""
    objective = Objective(SpotRadius(), Problem(VIEW, LIMITS, 0), None, False, 1)
    settings = GradientDesignSettings(descents=[{"steps": 3, "criterion": "spot"}])
    descent = Descent(start, objective, settings, settings.descents[0], 0)
    validations = iter([(0.3, 1.0), (0.2, 1.0), (0.9, 0.0), (0.1, 1.0)])  # loss and violation [mm]

    def validate() -> tuple[bool, float]:
        loss, violation = next(validations)
        monkeypatch.setattr(descent, "_validation_loss", lambda vector, far: loss)
        monkeypatch.setattr(descent.optimizer, "violation", lambda: violation)
        descent._validate()
        return descent.least

    assert [validate() for _ in range(4)] == [(True, 0.3), (True, 0.2), (False, 0.9), (False, 0.9)]


def test_adamw_penalises_angles_of_incidence_and_moves_only_free_variables(start):
    changes = {}
    for largest_deg in (None, 10.0):
        settings = DescentSettings(optimizer="adamw", steps=3, max_incidence_deg=largest_deg)
        optimizer = AdamWOptimizer(start, replace(Problem(VIEW, LIMITS, 0), free={"curvature": (1,)}), settings)
        vector = optimizer.vector()
        lens = optimizer.lens(vector)
        change = optimizer.change(vector, lens, lens.curvature.square().sum(), 0.0, 1.0)
        changes[largest_deg] = change, optimizer.penalty
        optimizer.apply(change)
        moved = optimizer.vector().detach() != vector.detach()
        assert moved.tolist() == optimizer.free.tolist() and moved.sum() == 1
    assert changes[10.0][1] > changes[None][1] and not torch.equal(changes[10.0][0], changes[None][0])
