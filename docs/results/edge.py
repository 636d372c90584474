"""Draw where on the sensor the task gains: `python docs/results/edge.py [RESULTS ...]`.

The program reads the published accuracies of doublets in 16 cells of equal area, and draws edge.svg: gains over image
correlation from the axis to the corner, means over sets. It prints the gains at the edge and within and, for the noise
study, their correlation to those in I over the cells of each set. RESULTS are results folders of points of the noise
study, from which it writes noise/signal_to_noise.csv anew:

I = mean of log2(1 + S |H|^2 / N) over 1/8 <= |f| < 1/4 cycles per pixel

S is the mean power spectrum of the luminance of minival images in linear light, H the transfer function of a PSF, and N
the variance of the sensor's noise at their mean light. A cell has the mean of its four fields.
"""

import sys
from pathlib import Path

import matplotlib
import pandas
import torch
from kornia.color import rgb_to_linear_rgb
from matplotlib.figure import Figure
from torch import Tensor

from tasklens.fields import GRADING_CENTRES
from tasklens.optics.io import psf_files
from tasklens.recognition import dataset
from tasklens.settings.capture_settings import SensorSettings
from tasklens.settings.field_settings import radii
from tasklens.show import vector_files
from tasklens.study import loading

FOLDER = Path(__file__).parent
ASPECT = loading.load(FOLDER.parents[1] / "config/headline.yaml").spec.aspect
SIGNAL_TO_NOISE = FOLDER / "noise/signal_to_noise.csv"
EDGE = 0.75  # of the corner's distance: 4 of the 16 cells are beyond it
BAND = (1 / 8, 1 / 4)
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
STUDIES = {  # titles of panels
    "replication_sensor": "ten sets, no noise",
    "photographs_sensor": "photographs, no noise",
    "indoors_sensor": "indoor noise",
    "noise/gain=64": "noise at 94 electrons",
}
CURVES = {  # lenses, labels and colours
    "tasklens_from_quality": ("task, from an image-quality lens", "#0072B2"),
    "tasklens_joint": ("task, network trained jointly", "#D55E00"),
    "image_corner": ("image correlation, corner weighted", "#009E73"),
}
BASELINE = "image_correlation"


def signal_to_noise(psf: Tensor, illumination: Tensor, images: Tensor, sensor: SensorSettings) -> Tensor:
    """Compute I of PSFs (F, 3, K, K) for images (B, 3, H, W) in linear light, as (F,)."""
    size = images.shape[-1]
    grey = torch.einsum("bchw,c->bhw", images, LUMINANCE)
    window = torch.hann_window(size, dtype=torch.float64)
    window = window[:, None] * window
    spectrum = torch.fft.fft2((grey - grey.mean((1, 2), keepdim=True)) * window).abs().square().mean(0)
    spectrum = spectrum / window.square().sum()
    transfer = torch.einsum("fchw,c->fhw", torch.fft.fft2(psf, s=(size, size)), LUMINANCE.to(torch.complex128))
    white = sensor.full_well / sensor.gain * illumination
    noise = LUMINANCE.square().sum() * (grey.mean() / white + (sensor.read_noise / white).square())
    ratio = spectrum * transfer.abs().square() / noise[:, None, None]
    frequency = torch.fft.fftfreq(size, dtype=torch.float64)
    frequency = torch.hypot(frequency[:, None], frequency)
    return torch.log2(1 + ratio[:, (frequency >= BAND[0]) & (frequency < BAND[1])]).mean(1)


def lenses_of(results: Path) -> pandas.DataFrame:
    """Return I of the lenses of one results folder, a row per lens and cell."""
    study = loading.load(results / "study.yaml")
    sensor = study.capture.sensor
    assert sensor is not None, f"{results}: a study without noise"
    images = dataset.read(results / "images/minival.npy", results / "images/minival.json")
    light = rgb_to_linear_rgb(images.batch(torch.arange(len(images)))[0]).double()
    parts = []
    for path in sorted(results.glob("lenses/doublet-*/seed*/psf.safetensors")):
        psf, illumination, turns = psf_files.read(path, "grading")
        values = signal_to_noise(psf.double(), illumination.double(), light, sensor).unflatten(0, (turns, -1)).mean(0)
        design = path.parents[1].name.partition("-")[2]
        parts.append(pandas.DataFrame({"design": design, "cell": range(len(values)), "i": values}))
    return pandas.concat(parts).assign(study=f"noise/gain={sensor.gain:g}", set=study.images.seed)


def accuracies(study: str) -> pandas.DataFrame:
    """Return the published accuracies [%] of the doublets of a study, a row per set, lens and cell."""
    parts = []
    for path in sorted((FOLDER / study).rglob("table1.seeds.csv")):
        table = pandas.read_csv(path)
        table = table[(table["elements"] == "doublet") & (table["classifier"] == table["classifier"].iloc[-1])]
        cells = [f"accuracy_field{cell}" for cell in range(len(GRADING_CENTRES))]
        by_cell = table.set_index("design")[cells].set_axis(range(len(cells)), axis=1)
        by_cell = by_cell.rename_axis(columns="cell").stack().rename("accuracy").reset_index()
        parts.append(by_cell.assign(study=study, set=path.parent.name.partition("=")[2]))
    return pandas.concat(parts)


def gains(table: pandas.DataFrame) -> pandas.DataFrame:
    """Return what lenses gain over the baseline in each cell, by study, set, cell and design."""
    keys = ["study", "set", "cell"]
    baseline = table[table["design"] == BASELINE].drop(columns="design").set_index(keys)
    others = table[table["design"].isin(CURVES)].set_index([*keys, "design"])
    gain = (others - baseline).reset_index()
    distances = dict(enumerate(radii(GRADING_CENTRES, ASPECT)))
    return gain.assign(radius=gain["cell"].map(distances))


def draw(gain: pandas.DataFrame, path: Path) -> None:
    """Draw the gains [points], means over sets, from the axis to the corner: a panel per study."""
    with matplotlib.rc_context({**vector_files.STYLE, "font.size": 9}):
        figure = Figure(figsize=(9, 2.8), layout="constrained")
        for axes, (study, title) in zip(figure.subplots(1, len(STUDIES), sharey=True), STUDIES.items(), strict=True):
            of_study = gain[gain["study"] == study]
            for design, (label, colour) in CURVES.items():
                curve = of_study[of_study["design"] == design].groupby("radius")["accuracy"].mean()
                axes.plot(curve.index, curve, "o-", color=colour, linewidth=1.2, markersize=3, label=label)
            axes.axhline(0, color="grey", linewidth=0.7)
            axes.axvline(EDGE, color="grey", linewidth=0.7, linestyle=":")
            axes.set_title(title, fontsize="medium", loc="left")
            axes.set(xlim=(0, 1), xlabel="radius [of the corner]")
            axes.spines[["top", "right"]].set_visible(False)
        figure.axes[0].set_ylabel("gain [points]")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
        figure.savefig(path, format="svg", metadata=vector_files.METADATA["svg"])


def main() -> None:
    """Write the figure, and print the summary."""
    if sys.argv[1:]:
        new = pandas.concat([lenses_of(Path(folder)) for folder in sys.argv[1:]])
        new[["study", "set", "design", "cell", "i"]].to_csv(SIGNAL_TO_NOISE, index=False, float_format="%.5g")
    levels = [f"noise/{path.name}" for path in FOLDER.glob("noise/gain=*")]
    gain = gains(pandas.concat([accuracies(study) for study in {*STUDIES, *levels}]))
    draw(gain, FOLDER / "edge.svg")
    edge = gain["radius"] > EDGE
    keys = ["study", "design", "set"]
    summary = pandas.DataFrame(
        {name: gain[part].groupby(keys)["accuracy"].mean() for name, part in (("edge", edge), ("within", ~edge))}
    )
    more = gains(pandas.read_csv(SIGNAL_TO_NOISE, dtype={"set": str}))
    both = gain.merge(more, on=[*keys, "cell"])
    summary["correlation"] = both.groupby(keys)[["accuracy", "i"]].corr().iloc[::2, 1].droplevel(-1)
    print(summary.round(2).to_string(), summary.groupby(keys[:2]).mean().round(1).to_string(), sep="\n")


if __name__ == "__main__":
    main()
