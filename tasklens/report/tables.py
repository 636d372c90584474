"""The paper's four tables from measured rows, with the paper's values beside them.

A value of the paper is of another data set (ImageNet) and other networks: its columns end in `_paper`.
"""

import importlib.metadata
import json
import subprocess
from pathlib import Path

import pandas

from tasklens.pipeline.jobs import TableJob
from tasklens.pipeline.layout import PAPER, SHARP, Layout
from tasklens.runtime.files import write_text

PACKAGES = ("torch", "torchvision", "timm", "kornia", "snakemake", "pandas")
_COLUMNS = {
    "table1": ["accuracy", "psnr_db", "rms_spot_um", "core_radius_um", "energy_in_window", "worst_margin"],
    "table2": ["parameters_m", "reference_accuracy", "accuracy"],
    "table3": ["accuracy", "energy_in_window", "worst_margin", "converged"],
    "table4": ["psnr_db", "worst_psnr_db", "accuracy"],
}
_ZERO_SHOT = "zero_shot_accuracy"  # follows the accuracy in tables 1 and 2, if a network has more outputs than classes
_TITLES = {
    "table1": "Classification accuracy, image quality and spot size of each lens",
    "table2": "Accuracy with other classifiers",
    "table3": "Task-driven against end-to-end design",
    "table4": "After image restoration",
}


def lens_file(path: Path) -> dict:
    """What a lens file says, unchecked and without torch."""
    import yaml

    return yaml.load(path.read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def lens_values(path: Path) -> dict[str, float]:
    """Means over the nine fields of what a lens file says: RMS and 50 % radius [um], energy inside the window.

    And its worst margin, negative where the lens breaks a limit of manufacturing [mm], focal length or distortion.
    """
    content = lens_file(path)
    figures = content["figures"]

    def mean(key: str) -> float:
        return sum(figures[key]) / len(figures[key])

    return {
        "rms_spot_um": mean("rms_centroid_um"),
        "core_radius_um": mean("radius_50_um"),
        "energy_in_window": mean("energy_in_window"),
        "worst_margin": content["worst_margin"]["value"],
    }


def measured_values(path: Path) -> dict[str, float]:
    """Mean over fields of every metric in a metrics file."""
    rows = pandas.read_csv(path)
    return rows.groupby("metric")["value"].mean().to_dict()


def converged(accuracy: float, reference_accuracy: float, chance: float, energy_in_window: float) -> bool:
    """Whether a design converged: it forms an image, and the image serves.

    At least half of the light of the average field falls inside the PSF window, and the fine-tuned classifier recovers
    at least half of what the sharp pictures give above chance.
    """
    return energy_in_window >= 0.5 and accuracy >= (reference_accuracy + chance) / 2


def collect(job: TableJob, layout: Layout, partial: bool) -> pandas.DataFrame:
    """One row per lens (or `reference`), classifier and seed.

    Raises:
        FileNotFoundError: a measurement is missing and `partial` is false.
    """
    rows = []
    for seed in job.seeds:
        for classifier in job.classifiers:
            sharp_path = Path(layout.metrics(SHARP, seed, classifier))
            if partial and not sharp_path.exists():
                continue
            sharp = measured_values(sharp_path)
            reference = sharp["accuracy"]
            if job.name == "table1":
                shown = {key: sharp[key] for key in ("accuracy", _ZERO_SHOT) if key in sharp}
                rows.append({"elements": "", "design": "reference", "seed": seed} | shown)
            for lens in job.lenses:
                elements, _, design = lens.partition("-")
                paths = [Path(layout.metrics(lens, seed, job.seen(classifier))), Path(layout.lens(lens, seed))]
                if partial and not all(path.exists() for path in paths):
                    continue
                values = measured_values(paths[0]) | lens_values(paths[1]) | {"reference_accuracy": reference}
                values["converged"] = converged(
                    values["accuracy"], reference, sharp["chance"], values["energy_in_window"]
                )
                keys = {"elements": elements, "design": design, "classifier": classifier, "seed": seed}
                rows.append(keys | values)
    return pandas.DataFrame(rows)


def _columns(job: TableJob, rows: pandas.DataFrame) -> list[str]:
    """What a table shows of its rows."""
    columns = list(_COLUMNS[job.name])
    if job.name in ("table1", "table2") and _ZERO_SHOT in rows:
        columns.insert(columns.index("accuracy") + 1, _ZERO_SHOT)
    return columns


def summarise(job: TableJob, rows: pandas.DataFrame, paper: pandas.DataFrame) -> pandas.DataFrame:
    """Means over seeds, with `_std` where several ran, beside the paper's values.

    Of margins the worst counts, and a design converged where it did with every seed.
    """
    columns = _columns(job, rows)
    keys = ["elements", "design", *(["classifier"] if job.name == "table2" else [])]
    groups = rows.groupby(keys, sort=False)
    table = groups.agg({c: {"converged": "all", "worst_margin": "min"}.get(c, "mean") for c in columns})
    if len(job.seeds) > 1:
        spread = groups[[c for c in columns if c not in ("converged", "worst_margin")]].std(ddof=1)
        table = table.join(spread.add_suffix("_std"))
    table = table.reset_index()
    wanted = paper[paper["table"] == job.name]
    published = wanted.pivot_table(index=keys, columns="metric", values="value", sort=False)
    shared = [c for c in columns if c in published and c != "parameters_m"]
    return table.merge(published[shared].add_suffix("_paper").reset_index(), on=keys, how="left")


def printed(job: TableJob, table: pandas.DataFrame) -> pandas.DataFrame:
    """The table as people read it: rounded, gaps as dashes, a cross where a design did not converge."""
    shown = table.copy()
    for column in shown.columns:
        if column.startswith("converged"):
            shown[column] = shown[column].map(lambda v: "–" if pandas.isna(v) else "yes" if v else "×")
        elif pandas.api.types.is_float_dtype(shown[column]):
            digits = 3 if column.startswith(("energy", "worst")) else 2
            shown[column] = shown[column].map(lambda v, d=digits: "–" if pandas.isna(v) else f"{v:.{d}f}")
    return shown.fillna("–")


def make(job: TableJob, layout: Layout, study: str, partial: bool) -> None:
    """Write a table as CSV, Markdown and LaTeX, its rows seed by seed, and a sidecar that says what made it."""
    paper = pandas.read_csv(PAPER, keep_default_na=False)
    paper["value"] = pandas.to_numeric(paper["value"])
    rows = collect(job, layout, partial)
    if rows.empty:
        raise FileNotFoundError(f"{job.name}: nothing has been measured yet below {layout.root}/metrics")
    rows = rows.reindex(columns=list(dict.fromkeys([*rows, *_COLUMNS[job.name]])))
    table = summarise(job, rows, paper)
    shown = printed(job, table)
    title = f"Table {job.name[-1]}: {_TITLES[job.name]}"
    name = f"{job.name}-partial" if partial else job.name
    unmeasured = [lens for lens in job.lenses if not (rows["elements"] + "-" + rows["design"]).eq(lens).any()]
    note = f"Not measured yet: {', '.join(unmeasured)}. " if unmeasured else ""
    note += f"Study `{study}`. Columns `_paper`: Yang et al. 2024, measured on ImageNet with other networks."
    write_text(Path(layout.table(name, "csv")), table.to_csv(index=False))
    each = [c for c in ("elements", "design", "classifier", "seed", *_columns(job, rows)) if c in rows]
    write_text(Path(layout.table(name, "seeds.csv")), rows[each].to_csv(index=False))
    markdown = shown.to_markdown(index=False, disable_numparse=True)
    write_text(Path(layout.table(name, "md")), f"**{title}**\n\n{markdown}\n\n{note}\n")
    latex = shown.to_latex(index=False, escape=True, caption=_latex(f"{title}. {note}"))
    write_text(Path(layout.table(name, "tex")), latex)
    write_text(Path(layout.table(name, "json")), json.dumps(provenance(study, job), indent=1) + "\n")


def _latex(text: str) -> str:
    """Our own plain sentences as LaTeX."""
    return text.replace("`", "").replace("_", r"\_")


def provenance(study: str, job: TableJob) -> dict:
    """What made a table: study, seeds, commit and versions."""
    try:
        command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
        commit = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"study": study, "seeds": list(job.seeds), "commit": commit, "versions": versions}
