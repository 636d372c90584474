"""Built lenses: yields by spot and MTF, without a network, and the tolerances that they can have."""

import json
import math
import statistics
from dataclasses import replace

import pytest
import torch
from examples import cooke_file, cooke_triplet, f64
from tolerance_examples import doublet, grade

from tasklens.cli.app import main
from tasklens.optics.analysis.pupil import rim
from tasklens.optics.analysis.spots import lit_semi_diameters, trace_fields
from tasklens.optics.tolerancing import monte_carlo, yields
from tasklens.optics.tolerancing.manufacturing_errors import errors
from tasklens.optics.view import View
from tasklens.settings.tolerance_settings import GRADES, Grade
from tasklens.show.yield_tables import summary

VIEW = View(f64([[0.0, 0.0], [0.0, 9.0], [0.0, 18.0]]), 50.0, (0.5876,), 20.0, 51)
FINE = Grade.model_validate({name: 0.02 * value for name, value in GRADES["precision_moulding"].items()})


@pytest.fixture(scope="module")
def fine_tolerances():
    return yields.tolerances(cooke_triplet(), VIEW, FINE, 10, 0)


def spread(tolerances: dict) -> float:
    """RMS deviation of the built lenses' spots from the design's [um]."""
    design = tolerances["design"]["rms_spot_um"]
    return math.sqrt(sum((lens["rms_spot_um"] - design) ** 2 for lens in tolerances["built"]))


def displacements_um(tolerances: dict) -> list[float]:
    return [error["moved_um"] for error in tolerances["errors"]]


def mean_factor(tolerances: dict) -> float:
    """Mean ratio of the allotted tolerances to the grade's."""
    return statistics.fmean(error["allotted"] / error["tolerance"] for error in tolerances["errors"])


@pytest.mark.slow
def test_spots_deviate_in_proportion_to_small_errors(fine_tolerances):
    """A tenth of the same errors gives a tenth of the deviations, up to second order."""
    tenth = Grade.model_validate({name: 0.1 * getattr(FINE, name) for name in GRADES["precision_moulding"]})
    finer = yields.tolerances(cooke_triplet(), VIEW, tenth, 10, 0)
    assert spread(finer) == pytest.approx(0.1 * spread(fine_tolerances), rel=0.2) and spread(fine_tolerances) > 0.05
    assert displacements_um(finer) == pytest.approx([0.1 * um for um in displacements_um(fine_tolerances)], rel=1e-6)
    assert finer["design"] == fine_tolerances["design"] and len(fine_tolerances["built"]) == 10


@pytest.mark.slow
def test_fine_tolerances_are_loosened_and_coarse_ones_tightened(fine_tolerances):
    """For the same lens, the ratio of allotted tolerances to the grade falls for a coarser grade."""
    coarse = yields.tolerances(cooke_triplet(), VIEW, Grade.model_validate("commercial_moulding"), 10, 0)
    assert spread(coarse) > 10 * spread(fine_tolerances)
    assert mean_factor(fine_tolerances) > 1 and mean_factor(coarse) < mean_factor(fine_tolerances)


def test_an_aperture_that_stops_all_rim_rays_darkens_no_field():
    """Clear apertures are then those of the rays inside the pupil."""
    lens = cooke_triplet()
    clear = lens.semi_diameter.clone()
    clear[0] = 4.0
    vignetting = replace(lens, semi_diameter=clear)
    view = replace(VIEW, fields=f64([[0.0, 0.0], [0.0, 0.4]]))
    assert not trace_fields(vignetting, view, rim(64)).valid.any()
    radii = lit_semi_diameters(vignetting, view)
    assert 3.9 < float(radii[0]) <= 4.0
    assert yields.tolerances(vignetting, view, grade(thickness_um=1.0), 1, 0)["design"]["rms_spot_um"] > 0


def test_yields_by_hand():
    """Twenty lenses with spots of 1.0 to 2.9 times the design's, and MTFs of 1.0 to 0.05 times its own."""
    built = [
        {"rms_spot_um": 2 * (1 + 0.1 * k), "rms_spot_worst_um": 3 + k, "mtf_quarter_nyquist": 0.6 * (1 - 0.05 * k)}
        for k in range(20)
    ]
    error_list = errors(cooke_triplet(), grade(thickness_um=1.0))[:3]
    rows = monte_carlo.error_rows(error_list, None, moved_um=[1.0, 3.0, 2.0])
    data = summary({"design": built[0], "built": built, "errors": rows, "peak_um": 0.0}, "mine", 10.0)
    assert data["yield_by_rms_percent"] == pytest.approx({1.1: 10, 1.25: 15, 1.5: 30, 2.0: 55})
    assert data["yield_by_mtf_percent"] == pytest.approx({0.95: 10, 0.9: 15, 0.8: 25, 0.6: 45})
    assert data["at_95_percent_yield"] == pytest.approx(
        {"rms_spot_um": 2 * 2.805, "rms_spot_worst_um": 3 + 18.05, "mtf_quarter_nyquist": 0.6 * 0.0975}
    )
    assert [row["error"] for row in data["errors"]] == [error_list[k].name for k in (1, 2, 0)]


def test_tolerances_are_the_cheapest_for_their_effect():
    """No others with the same mean square displacement have a smaller sum of inverse tolerances."""
    effects = f64([0.2, 1.0, 3.0, 0.7])
    tolerances = monte_carlo.cheapest(effects, 0.5)
    generator = torch.Generator().manual_seed(0)
    for _ in range(50):
        other = tolerances * torch.exp(0.3 * torch.randn(4, generator=generator, dtype=torch.float64))
        other = other * ((tolerances * effects).square().sum() / (other * effects).square().sum()).sqrt()
        assert (1 / other).sum() >= (1 / tolerances).sum() - 1e-12
    assert monte_carlo.cheapest(f64([0.0, 1.0]), 1.0).max() <= 4.0  # wider tolerances would gain nothing


def test_a_drawing_has_one_tolerance_for_x_and_y():
    all_errors = errors(doublet()[0], grade(element_decentre_um=1.0, thickness_um=1.0))
    names = [error.name for error in all_errors]
    effects = torch.arange(1.0, 1.0 + len(all_errors), dtype=torch.float64)
    common = dict(zip(names, monte_carlo.both_axes(all_errors, effects).tolist(), strict=True))
    x, y = (float(effects[names.index(f"element decentre 1 {axis}")]) for axis in "xy")
    assert common["element decentre 1 x"] == common["element decentre 1 y"] == pytest.approx(math.hypot(x, y) / 2**0.5)
    assert common["thickness 3"] == float(effects[names.index("thickness 3")])


def test_the_widest_tolerances_that_pass():
    effects = f64([0.2, 1.0, 3.0])
    tolerances = monte_carlo.widest(effects, lambda t: float((t * effects).square().sum()) <= 1.0)
    assert 0.6 < float((tolerances * effects).square().sum()) <= 1.0
    assert monte_carlo.widest(effects, lambda t: False) is None
    tight = monte_carlo.widest(effects, lambda t: float((t * effects).square().sum()) <= 0.01)
    assert 0.006 < float((tight * effects).square().sum()) <= 0.01
    tried = []
    assert monte_carlo.widest(effects, lambda t: not tried.append(t)) is not None
    assert len(tried) < monte_carlo.TRIALS


@pytest.mark.slow
def test_the_command(here, monkeypatch, capsys):
    """JSON and text of the same lenses, which are simulated once."""
    simulate, results = yields.tolerances, {}

    def simulate_once(lens, view, grade, count, seed):
        key = str(grade), count, seed
        if key not in results:
            results[key] = simulate(lens, view, grade, count, seed)
        return results[key]

    monkeypatch.setattr(yields, "tolerances", simulate_once)
    fields = ("angle_deg", ((0.0, 0.0), (0.0, 15.0)))
    cooke_file(here / "lens.zmx", fields=fields, wavelengths_um=(0.5876,), primary=0)
    command = ["lens", "tolerance", "lens.zmx", "--lenses", "10", "--pixel-pitch", "20", "--kernel-size", "51"]
    assert main([*command, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["lenses"] == 10 and result["grade"] == "precision_moulding"
    assert result["yield_by_rms_percent"]["2.0"] >= result["yield_by_rms_percent"]["1.1"]
    assert result["median"]["rms_spot_um"] > result["design"]["rms_spot_um"]
    displacements = [error["moved_um"] for error in result["errors"]]
    assert displacements == sorted(displacements, reverse=True)
    assert main(command) == 0
    text = capsys.readouterr().out
    assert "10 lenses built to precision moulding" in text and result["errors"][0]["error"] in text
    assert main([*command, "--grade", "perfect"]) == 2
    assert "--grade perfect: expected one of commercial_moulding" in capsys.readouterr().err
