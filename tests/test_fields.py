"""Designs and gradings see fields that are uniform in area, and what fits only some fields is found between them."""

from dataclasses import replace

import numpy
import pandas
import pytest
import torch
from designs import GRADED, LIMITS, OWN, SELECTED, VIEW, problem, tiny_network
from examples import HEADLINE, f64
from scipy.stats import chi2
from torch import nn

import tasklens
from tasklens.camera.imaging import PsfCamera
from tasklens.design.constraints import all_margins, limit_margins, worst_margin
from tasklens.design.criteria import TaskLoss
from tasklens.design.image_quality import Contrast, SpotRadius
from tasklens.design.merit import limit_semi_diameters
from tasklens.design.objective import Objective
from tasklens.design.problem import Problem
from tasklens.design.ray_space import repair
from tasklens.fields import CELLS, CORNER, GRADING_CENTRES, PAPER, SELECTION, cell_centres
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import OUTLINE, clear_semi_diameters
from tasklens.optics.io import prescription
from tasklens.optics.lens import Lens
from tasklens.optics.view import drawn_points, view_of_spec
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.runtime.files import FileError
from tasklens.settings.capture_settings import SensorSettings
from tasklens.settings.specification import Spec
from tasklens.show import between_fields


def published(name: str) -> Lens:
    """A lens of the headline study."""
    return prescription.read(HEADLINE / f"{name}.yaml")[0].lens


def test_draws_are_uniform_in_area():
    """Each of nine cells has a point in every draw, row by row; the same seed repeats the points.

    25 points are expected in each of 12 x 12 equal squares; chi-squared of 9 (16 - 1) degrees of freedom.
    """
    points = drawn_points(400, seed=3)
    cells = (CELLS * points).long().reshape(400, CELLS**2, 2)
    assert torch.equal(cells, (CELLS * f64(cell_centres(CELLS))).long().expand(400, -1, -1))
    assert torch.equal(points, drawn_points(400, seed=3)) and not torch.equal(points, drawn_points(400, seed=2))
    counts, *_ = numpy.histogram2d(*points.T.numpy(), bins=12, range=[[0, 1], [0, 1]])
    statistic = ((counts - 25) ** 2 / 25).sum()
    assert chi2.ppf(0.001, 135) < statistic < chi2.ppf(0.999, 135)


@pytest.mark.parametrize("fields, cells", [(SELECTED, 6), (GRADING_CENTRES, 4), (GRADED, 8)])
def test_fixed_sets_are_uniform_in_area(fields, cells):
    """Moments of cell centres: 1/2, 1/3 less the variance of a cell, 1/4. The paper's nine are farther out."""
    u, v = f64(fields).T
    for mean in (u.mean(), v.mean()):
        assert float(mean) == pytest.approx(1 / 2)
    for square in ((u**2).mean(), (v**2).mean()):
        assert float(square) == pytest.approx(1 / 3 - 1 / (12 * cells**2))
    assert float((u * v).mean()) == pytest.approx(1 / 4)
    assert float((f64(PAPER)[:, 0] ** 2).mean()) == pytest.approx(5 / 12)


def test_lenses_are_graded_where_nothing_was_chosen():
    """No field of the grading is one of the selection, of the paper or of the draws."""
    assert len({*GRADED}) == 64 and {*GRADED}.isdisjoint({*SELECTED, *PAPER, *CORNER})
    assert {*GRADED}.isdisjoint(map(tuple, drawn_points(50, seed=0).tolist()))


@pytest.mark.parametrize("sensor", [None, SensorSettings(full_well=1e8)])
def test_images_take_the_quarters_of_the_cells_in_turns(sensor):
    """Image i is captured at the fields of the set i modulo four; the last batch may be small."""
    generator = torch.Generator().manual_seed(0)
    psf = torch.rand(4 * 3, 3, 5, 5, generator=generator) / 25
    camera = PsfCamera(psf, sensor=sensor)
    images = torch.rand(6, 3, 16, 16, generator=generator)
    captures = CapturePipeline(camera, turns=4).all_fields(images, 7)
    assert captures.shape == (3, *images.shape)
    tolerance = 1e-5 if sensor is None else 2 / 255  # 8 bits, nearly without noise
    for k in range(3):
        no_noise = None if sensor is None else torch.zeros_like(images)
        expected = camera(images, [3 * (i % 4) + k for i in range(6)], no_noise)
        assert (captures[k] - expected).abs().max() < tolerance
    if sensor is None:
        assert CapturePipeline(camera, turns=4).all_fields(images[:1]).shape == (3, 1, 3, 16, 16)


class Numbered(PsfCamera):
    """A camera that returns the number of the field of each image."""

    def __init__(self, count: int, sensor: SensorSettings | None = None):
        psf = torch.zeros(count, 3, 3, 3)
        psf[..., 1, 1] = 1
        super().__init__(psf, sensor=sensor, illumination=None if sensor is None else torch.ones(count))

    def __call__(self, images, fields, sample=None):
        self.sample = sample
        return fields


def test_training_at_nine_fields_draws_the_numbers_of_before():
    """A field of each image, then the noise of the sensor; a draw of nine has no number of its own."""
    images, camera = torch.ones(30, 3, 4, 4), Numbered(9, SensorSettings())
    fields = CapturePipeline(camera).one_field(images, torch.Generator().manual_seed(5))
    generator = torch.Generator().manual_seed(5)
    assert torch.equal(fields, torch.randint(9, (30,), generator=generator))
    assert torch.equal(camera.sample, torch.randn(images.shape, generator=generator))


def test_a_step_of_training_sees_one_draw():
    """Of eight; over many steps all of them, and all fields of each."""
    pipeline, generator = CapturePipeline(Numbered(72), turns=8), torch.Generator().manual_seed(0)
    steps = [pipeline.one_field(torch.ones(30, 3, 4, 4), generator) for _ in range(60)]
    assert all(len({*(fields // 9).tolist()}) == 1 for fields in steps)
    assert {*torch.cat(steps).tolist()} == {*range(72)}


def answers(*rates: float, count: int = 60, fields: int = 9, seed: int = 0) -> pandas.DataFrame:
    """Answers to images, of which these fractions are right at the first and at the other fields."""
    random = numpy.random.default_rng(seed).random((count, fields))
    index = pandas.MultiIndex.from_tuples([(k, "cat") for k in range(count)], names=["image", "label"])
    right = random < numpy.where(numpy.arange(fields) % 2, rates[-1], rates[0])
    return pandas.DataFrame(right.astype(int), index)


def test_a_lens_that_is_right_at_its_fields_only_is_named():
    """A lens that is equal, or better between its fields, is not."""
    between = {"fitted": answers(0.8, fields=16), "equal": answers(0.9, fields=16), "better": answers(0.9, fields=16)}
    own = {"fitted": answers(0.9, seed=1), "equal": answers(0.9, seed=1), "better": answers(0.8, seed=1)}
    (sentence,) = between_fields.warnings(between, own, "its own fields")
    rates = [100 * part["fitted"].to_numpy().mean() for part in (own, between)]
    words = f"fitted is fitted to its own fields: {rates[0]:.1f} % there, {rates[1]:.1f} % between them "
    assert sentence.startswith(f"{words}({rates[0] - rates[1]:.1f} points less, ") and sentence.endswith(").")
    with pytest.raises(FileError, match=r"fitted.*test images differ"):
        between_fields.warnings({"fitted": answers(0.8, count=50)}, {"fitted": own["fitted"]}, "its own fields")


class Sharpness(nn.Module):
    """Names the class of noise, dark or bright, if it is sharp; otherwise the other one."""

    def __init__(self, least: float):
        super().__init__()
        self.least = least

    def forward(self, images):
        bright = images.mean((1, 2, 3)) > 0.5
        sharp = images.diff(dim=-1).abs().mean((1, 2, 3)) > self.least
        return torch.stack([(bright != sharp).float(), (bright == sharp).float()], -1)


def test_fields_along_an_axis_span_a_square_quadrant():
    """With the same corner, so that a grading between them is uniform in area."""
    points = VIEW.along_y(VIEW.radii).at(GRADING_CENTRES)
    assert len({tuple(point) for point in points.fields.tolist()}) == len(GRADING_CENTRES)
    corner = VIEW.along_y(VIEW.radii).at([(1.0, 1.0)])
    assert float(corner.radii) == pytest.approx(float(VIEW.radii.max()))


def test_ranking_names_a_lens_fitted_to_the_nine_fields():
    """Of a published study, designed for the nine: it is sharper there than between them. Another is sharp at all."""
    grains = 0.4 * torch.rand(12, 3, 48, 48, generator=torch.Generator().manual_seed(0))
    images = [(image + 0.5 * (k % 2), k % 2) for k, image in enumerate(grains)]
    names = {"fitted": "doublet-tasklens_from_quality", "sharp": "quadruplet-imaging2"}
    lenses = {name: tasklens.load_lens(HEADLINE / f"{file}.yaml") for name, file in names.items()}
    with pytest.warns(UserWarning) as caught:
        result = tasklens.rank(lenses, images, Sharpness(0.0175), rays=512)
    (sentence,) = (str(warning.message) for warning in caught if "between them" in str(warning.message))
    assert sentence.startswith("rank: fitted is fitted to the paper's nine fields: ")
    for name in lenses:
        assert result.correct[name].shape == (12, 16) and result.at_nine[name].shape == (12, 9)
    row = result.table.set_index("lens").loc["fitted"]
    assert row["accuracy_at_nine"] > row["accuracy"] + 30
    assert row["accuracy"] == pytest.approx(100 * result.correct["fitted"].to_numpy().mean())
    assert (result.table.set_index("lens").loc["sharp", ["accuracy", "accuracy_at_nine"]] == 100).all()


def test_a_limit_that_is_violated_between_the_nine_fields_is_repaired():
    """The distortion of a published doublet is largest between the radii of the nine; its new limits hold at all."""
    lens, view = published("doublet-imaging1"), view_of_spec(Spec())
    apertures = torch.minimum(limit_semi_diameters(lens, view), lens.semi_diameter)
    _, at_nine = worst_margin(all_margins(lens, LIMITS, view, apertures))
    limit, everywhere = worst_margin(limit_margins(lens, LIMITS, view, apertures))
    assert at_nine == pytest.approx(0.0008, abs=1e-4)
    assert limit == "distortion" and everywhere == pytest.approx(-0.0049, abs=1e-4)
    repaired, radii_mm = repair(lens, view, LIMITS)
    dense = view.along_y(torch.linspace(0, 1, 300, dtype=torch.float64) * view.radii.max())
    margins = all_margins(repaired, LIMITS, dense, torch.minimum(radii_mm, repaired.semi_diameter))
    assert worst_margin(margins)[1] >= 0


def test_apertures_of_limits_pass_the_light_of_all_fields():
    """Of the nine and of any draw: with the reserve of 1 %, between the radii, too."""
    lens = published("doublet-imaging1")
    radii_mm = limit_semi_diameters(lens, VIEW)
    for view in (VIEW, *(VIEW.at(drawn_points(1, seed)) for seed in range(5))):
        assert (radii_mm > clear_semi_diameters(lens, view, OUTLINE)).all()


@pytest.mark.parametrize(
    "criterion",
    [SpotRadius(), Contrast(), TaskLoss(tiny_network().eval())],
    ids=lambda criterion: type(criterion).__name__,
)
def test_each_step_sees_other_fields(start, criterion):
    """Drawn by the seed of the step; a list is the same in all of them, and in validation."""

    def losses(posed: Problem, seed: int):
        objective = Objective(criterion, posed, None, False, 36)
        return objective.loss(start, sobol_disc(32, 0), 10.0, torch.arange(2), seed)

    drawn, fixed = problem(), replace(problem(), fields=OWN)
    first, again, other = (losses(drawn, seed) for seed in (0, 0, 1))
    assert torch.equal(first.view.fields, again.view.fields) and torch.equal(first.fields, again.fields)
    assert not torch.equal(first.view.fields, other.view.fields) and first.fields.shape == (9,)
    assert torch.equal(first.view.fields, VIEW.at(drawn_points(1, 0)).fields)
    one, two = (losses(fixed, seed) for seed in (0, 1))
    assert torch.equal(one.view.fields, two.view.fields) and torch.equal(one.fields, two.fields)
    assert torch.equal(one.view.fields, VIEW.at(OWN).fields) and one.fields.shape == (5,)
    for posed, sets in ((fixed, (OWN,)), (drawn, SELECTION)):
        for view, points in zip(posed.views_of_validation, sets, strict=True):
            assert torch.equal(view.fields, VIEW.at(points).fields)
