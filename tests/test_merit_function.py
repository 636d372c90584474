"""The merit function of a classifier: modulation of PSFs, its fit, and the table of what each classifier wants."""

from pathlib import Path

import numpy
import pandas
import pytest
import torch
from examples import write
from rules import finish, outputs
from studies import measurement, tiny_study

from tasklens.optics.io import psf_files
from tasklens.runtime.files import FileError
from tasklens.study.loading import parse
from tasklens.study.report import merit_function
from tasklens.study.report.merit_function import BANDS, fit, leave_one_out, modulation
from tasklens.study.report_jobs import MeritFunctionJob

KERNEL = 51


def gaussians(widths: list[float]) -> numpy.ndarray:
    """Normalised round Gaussians (N, 3, K, K) of these standard deviations [pixels]."""
    x = numpy.arange(KERNEL) - KERNEL // 2
    squares = x[:, None] ** 2 + x**2
    psf = numpy.stack([numpy.exp(-squares / (2 * width**2)) for width in widths])
    return numpy.repeat((psf / psf.sum((1, 2), keepdims=True))[:, None], 3, axis=1)


def test_modulation_is_that_of_gaussians():
    """exp(-k f^2), k = 2 (pi s)^2, mean over rings; a veil of half of the light halves it; a point has all of it."""
    widths = [0.8, 1.5]
    k, squares = 2 * (numpy.pi * numpy.array(widths)[:, None]) ** 2, BANDS**2
    expected = -numpy.diff(numpy.exp(-k * squares)) / (k * numpy.diff(squares))
    actual = modulation(gaussians(widths))
    numpy.testing.assert_allclose(actual, expected, atol=0.025)
    numpy.testing.assert_allclose(modulation(gaussians(widths) / 2), actual / 2, rtol=1e-12)
    point = numpy.zeros((1, 3, KERNEL, KERNEL))
    point[..., 7, 30] = 1
    numpy.testing.assert_allclose(modulation(point), 1, rtol=1e-12)


def test_a_merit_function_is_found_again():
    """Losses made with weights: the same weights; without noise, to rounding; none is negative."""
    random = numpy.random.default_rng(0)
    modulations = random.uniform(0, 1, (40, len(BANDS) - 1))
    weights = numpy.array([0, 0, 3.0, 5.0, 0, 0.5, 0, 0])
    merit = fit(modulations, 1.2 - modulations @ weights)
    numpy.testing.assert_allclose(merit.weights, weights, atol=1e-9)
    assert merit.constant == pytest.approx(1.2, abs=1e-9)
    wrong = fit(modulations, 1.2 + modulations @ weights)  # a loss that rises with the modulation
    assert (wrong.weights >= 0).all()


def test_a_lens_does_not_predict_itself():
    """One lens whose losses are a hundred times too large: its own prediction does not change, those of others do."""
    random = numpy.random.default_rng(1)
    modulations = random.uniform(0, 1, (40, len(BANDS) - 1))
    lenses = numpy.repeat(numpy.arange(4), 10)
    log_loss = -modulations.sum(1)
    spoiled = log_loss + 100 * (lenses == 2)
    clean, predicted = (leave_one_out(modulations, losses, lenses) for losses in (log_loss, spoiled))
    numpy.testing.assert_allclose(clean, log_loss, atol=1e-9)
    numpy.testing.assert_allclose(predicted[lenses == 2], clean[lenses == 2], atol=1e-9)
    assert (abs(predicted - clean)[lenses != 2] > 1).any()


def write_results(study, light: float) -> None:
    """Write files of Gaussian PSFs with this part of the light, and losses by those with all of it.

    They have a weight of 4 in one band, a different one per classifier.
    """
    random = numpy.random.default_rng(2)
    for lens in MeritFunctionJob.of(study).lenses:
        psf = gaussians(random.uniform(0.4, 3, 9).tolist())
        path = outputs("psfs", study, lens=lens, seed=0).psf
        path.parent.mkdir(parents=True, exist_ok=True)
        psfs, notes = (torch.from_numpy(light * psf), torch.ones(len(psf))), {"fields_mm": [[0, 0]] * len(psf)}
        psf_files.write(path, *psfs, {"selection": (0, len(psf), 1)}, notes)
        for name, band in (("small", 2), ("other", 5)):
            loss = numpy.exp(1 - 4 * modulation(psf)[:, band])
            losses = {"image": range(2), "label": ["cat", "dog"]}
            losses |= {f"field{k}": [0.5 * value, 1.5 * value] for k, value in enumerate(loss)}
            write(measurement(study.name, lens, name, 0, "-frozen"), pandas.DataFrame(losses).to_csv(index=False))


@pytest.mark.parametrize("outside_window, light", [("veil", 1.0), ("renormalise", 0.5)])
def test_the_table_says_what_each_classifier_wants(here, outside_window, light):
    """The planted bands; all of the variance; the other classifier ranked a little differently; a figure."""
    study = parse(tiny_study() | {"capture": {"outside_window": outside_window}})
    write_results(study, light)
    paths = finish("merit_function_table", study)
    rows = pandas.read_csv(paths.csv).set_index("classifier")
    for name, band in (("small", 2), ("other", 5)):
        weights = rows.loc[name].filter(like="weight_to_")
        assert weights.idxmax() == f"weight_to_{BANDS[band + 1]:g}" and weights.max() == pytest.approx(4, abs=0.1)
        assert rows.loc[name, "r2"] > 0.999
    assert rows.loc["small", "rank_correlation"] == pytest.approx(1, abs=1e-3)
    assert 0.9 < rows.loc["other", "rank_correlation"] <= 1
    assert paths.figure.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and "small" in paths.md.read_text()


def test_too_few_lenses_make_no_merit_function(here):
    study = parse(tiny_study())
    settings = MeritFunctionJob.of(study)
    few = settings.model_copy(update={"lenses": settings.lenses[:2]})
    with pytest.raises(FileError, match="2 lenses"):
        merit_function.make(few, [], [Path()] * len(few.frozen_keys), Path("a.csv"), Path("a.md"), Path("a.png"))
