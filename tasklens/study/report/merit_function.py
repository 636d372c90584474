"""The merit function of each classifier: its loss through a lens, predicted from the lens' MTF.

The loss of a frozen classifier at a field is close to exp(c - sum_k w_k M_k), where M_k is the mean modulation of the
PSF in a band of spatial frequencies, over all directions and colours. The weights w_k >= 0 show which frequencies
matter to the classifier, and so which PSF is the best for it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy
import pandas
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from scipy.optimize import nnls

from tasklens.camera.imaging import PsfCamera
from tasklens.optics.io import psf_files
from tasklens.optics.io.psf_files import FieldPsfs
from tasklens.runtime.files import FileError, replacing
from tasklens.show.publish import publish
from tasklens.study.report.measurements import Measurements
from tasklens.study.report_jobs import MeritFunctionJob

_LEAST_LENSES = 3
BANDS = numpy.linspace(0, 0.5, 9)  # bounds of the bands [cycles per pixel], up to the Nyquist frequency
_NOTE = """\
Study `{study}`. For each classifier before fine-tuning, the loss at a field is fitted by exp(c - sum w M): weights w
of the mean modulation M in bands of spatial frequency [cycles per pixel], from {fields} fields of {lenses} lenses.
"r2" is for the logarithm of the loss of lenses that were left out of the fit. "Rank correlation" is that of
the losses with those that the merit function of {supervisor} predicts for lenses left out."""


def modulation(psf: numpy.ndarray) -> numpy.ndarray:
    """Compute the mean modulation (N, B) of PSFs (N, W, K, K) in the bands; missing light has no contrast."""
    frequency = numpy.fft.fftfreq(psf.shape[-1])
    radius = numpy.hypot(frequency[:, None], frequency)
    mtf = abs(numpy.fft.fft2(psf)).mean(1)
    bands = [(radius > low) & (radius <= high) for low, high in pairwise(BANDS)]
    return numpy.stack([mtf[:, band].mean(-1) for band in bands], -1)


def _mean_modulation(stored: FieldPsfs, outside_window: str) -> numpy.ndarray:
    """Compute the modulation (N, B) of stored PSFs, the mean over turns, as losses are means over images."""
    grid = PsfCamera(stored.psf, outside_window=outside_window).psf.double().numpy()
    return modulation(grid).reshape(stored.turns, -1, len(BANDS) - 1).mean(0)


@dataclass(frozen=True)
class MeritFunction:
    """A merit function: weights (B,) >= 0 of the modulation, and the constant c."""

    weights: numpy.ndarray
    constant: float

    def log_loss(self, modulation: numpy.ndarray) -> numpy.ndarray:
        """Predict the logarithm of the loss (N,) from the modulation (N, B)."""
        return self.constant - modulation @ self.weights


def fit(modulation: numpy.ndarray, log_loss: numpy.ndarray) -> MeritFunction:
    """Fit a merit function to modulations (N, B) and logarithms of losses (N,) by non-negative least squares."""
    centre = modulation.mean(0)
    ones = numpy.ones((len(modulation), 1))
    *weights, plus, minus = nnls(numpy.hstack([centre - modulation, ones, -ones]), log_loss)[0]
    return MeritFunction(numpy.array(weights), float(plus - minus + centre @ weights))


def leave_one_out(modulation: numpy.ndarray, log_loss: numpy.ndarray, lenses: numpy.ndarray) -> numpy.ndarray:
    """Predict the logarithm of the loss (N,) of each lens by a fit without it."""
    predicted = numpy.empty_like(log_loss)
    for lens in numpy.unique(lenses):
        mask = lenses == lens
        predicted[mask] = fit(modulation[~mask], log_loss[~mask]).log_loss(modulation[mask])
    return predicted


def make(
    settings: MeritFunctionJob, psfs: Sequence[Path], frozen: Sequence[Path], csv: Path, md: Path, figure: Path
) -> None:
    """Write the weights of all classifiers as CSV and Markdown, and draw them.

    Args:
        psfs: PSFs of the lenses in `settings.lens_keys`.
        frozen: losses of `settings.frozen_keys`.

    Raises:
        FileError: there are too few lenses.
    """
    supervisor = settings.supervisor
    measured = Measurements({}, {}, frozen=dict(zip(settings.frozen_keys, frozen, strict=True)))
    keys = settings.lens_keys
    names = sorted({lens for lens, _ in keys})
    if len(names) < _LEAST_LENSES:
        raise FileError(f"merit_function: {len(names)} lenses in the table; expected {_LEAST_LENSES} or more")
    stored = (psf_files.read(path, "selection") for path in psfs)
    modulations = numpy.concatenate([_mean_modulation(part, settings.outside_window) for part in stored])
    fields = len(modulations) // len(keys)
    lenses = numpy.repeat([names.index(lens) for lens, _ in keys], fields)  # all seeds of a lens are left out together
    losses = {
        name: numpy.log(numpy.concatenate([measured.frozen_losses(lens, name, seed).mean() for lens, seed in keys]))
        for name in settings.classifiers
    }
    fits = {name: fit(modulations, loss) for name, loss in losses.items()}
    predicted = {name: leave_one_out(modulations, loss, lenses) for name, loss in losses.items()}
    ranking = predicted[supervisor]
    table = pandas.DataFrame([_row(name, fits[name], losses[name], predicted[name], ranking) for name in losses])
    note = _NOTE.format(study=settings.study, fields=fields, lenses=len(names), supervisor=supervisor)
    publish(csv, md, table, note)
    _draw(figure, fits, losses, predicted)


def _row(
    name: str, merit: MeritFunction, loss: numpy.ndarray, predicted: numpy.ndarray, ranking: numpy.ndarray
) -> dict[str, object]:
    """Return the row of a classifier."""
    bands = {f"weight_to_{high:g}": weight for high, weight in zip(BANDS[1:], merit.weights, strict=True)}
    r2 = 1 - ((loss - predicted) ** 2).sum() / ((loss - loss.mean()) ** 2).sum()
    rank_correlation = pandas.Series(loss).corr(pandas.Series(ranking), method="spearman")
    return {"classifier": name, **bands, "constant": merit.constant, "r2": r2, "rank_correlation": rank_correlation}


def _draw(
    path: Path,
    fits: Mapping[str, MeritFunction],
    losses: Mapping[str, numpy.ndarray],
    predicted: Mapping[str, numpy.ndarray],
) -> None:
    """Draw the weights of all classifiers, and their losses against the predictions for lenses left out of the fit."""
    figure = Figure(figsize=(10, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, merit in fits.items():
        left.stairs(merit.weights, BANDS, label=name, linewidth=2)
        right.plot(numpy.exp(predicted[name]), numpy.exp(losses[name]), ".", label=name, alpha=0.6)
    left.set(xlabel="spatial frequency [cycles per pixel]", ylabel="weight of the modulation")
    left.set_title("Weights by frequency")
    right.axline((1, 1), slope=1, color="grey", linewidth=1)
    right.set(xscale="log", yscale="log", title="One point for each field of each lens")
    right.set(xlabel="loss predicted from the MTF, lens left out", ylabel="loss")
    for axis in (right.xaxis, right.yaxis):
        axis.set(major_locator=LogLocator(subs=(1, 2, 5)), major_formatter="{x:g}", minor_formatter=NullFormatter())
    left.legend()
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
