"""Assembly of the page from the files of a study; the answer in words comes first."""

import math
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import pandas
from plotly.offline import get_plotlyjs

from tasklens.runtime.benchmarks import benchmarks
from tasklens.runtime.files import read_json, read_table, read_yaml, write_text
from tasklens.show import pictures
from tasklens.show.headings import STD
from tasklens.show.optimality import optimum
from tasklens.show.publish import title
from tasklens.study.report import answer as answer_figure
from tasklens.study.report.page import gallery, page_captures, page_charts, page_tables, words
from tasklens.study.report_jobs import ReportJob

_SPREAD = " ± is the standard deviation over seeds."


@dataclass(frozen=True)
class PageFiles:
    """Input files of a page, as the rule names them.

    Attributes:
        table_files, seeds_files, provenance: tables, their rows by seed, and facts about the machine.
        histories, restorations: histories of each lens, and of the restoration networks.
        optional, drawn: tables and figures that are shown if they exist.
        benchmarks: folder of Snakemake's benchmarks.
    """

    table_files: Sequence[Path]
    seeds_files: Sequence[Path]
    provenance: Sequence[Path]
    verdicts: Path
    psf_tail: Path
    effort: Path
    histories: Sequence[Path]
    restorations: Sequence[Path]
    capture_file: Path
    answers: Path
    optional: Sequence[Path]
    drawn: Sequence[Path]
    benchmarks: Path


def make(settings: ReportJob, files: PageFiles, lens_files: gallery.LensFiles, report: Path, answer: Path) -> None:
    """Write the page, and the figure of its answer."""
    by_seed = {name: read_table(path) for name, path in zip(settings.tables, files.seeds_files, strict=True)}
    _draw_answer(answer, settings, next(iter(by_seed.items())), read_table(files.verdicts))
    write_text(report, render(settings, files, lens_files, by_seed, answer))


def render(
    settings: ReportJob,
    files: PageFiles,
    lens_files: gallery.LensFiles,
    by_seed: Mapping[str, pandas.DataFrame],
    answer: Path,
) -> str:
    """Return the page as HTML.

    Args:
        by_seed: rows of the tables by seed.
        answer: the figure of the answer.
    """
    optional = {table_name(path): path for path in files.optional}
    paths = dict(zip(settings.tables, files.table_files, strict=True))
    paths |= {"verdicts": files.verdicts, "psf_tail": files.psf_tail, "effort": files.effort}
    paths |= {name: path for name, path in optional.items() if path.exists()}
    frames = {name: read_table(path) for name, path in paths.items()}
    lenses = dict(zip(settings.elements, lens_files.lenses, strict=True))
    table1 = frames.get("table1")
    elements = dict.fromkeys(settings.elements.values())
    time = durations(files.benchmarks)
    optima = {lens: optimum(read_yaml(lenses[lens])) for lens in settings.with_optimum}
    sections: dict[str, Any] = {
        "study": settings.study,
        "seeds": settings.seeds,
        "supervisor": settings.supervisor,
        "summary": words.summary(frames["verdicts"], settings),
        "warnings": words.chance(by_seed),
        "tallies": words.tallies(frames["verdicts"], settings.paper_claims, settings.margins),
        "answer": pictures.link(answer),
        "names": settings.descriptions,
        "answers": words.answers(frames["verdicts"], elements, settings.questions, settings.margins),
        "best": {} if table1 is None else words.best_lenses(table1, settings.by_task),
        "convergence": words.convergence({lens: test for lens, test in optima.items() if test is not None}),
        "optional": [name for name in optional if name not in frames],
        "tables": [_table(name, frames[name]) for name in settings.tables],
        "verdicts": _table("verdicts", frames["verdicts"]),
        "more": [_table(name, frames[name]) for name in ("psf_tail", "effort")],
        "further": [
            _table(name, frames[name], _of_earlier_lenses(path, lenses))
            for name, path in optional.items()
            if name in frames
        ],
        "drawn": {path.stem: pictures.link(path) for path in files.drawn if path.exists()},
        "charts": _charts(settings, elements, frames, by_seed.get("table1")),
        "gallery": gallery.entries(settings, lens_files, by_seed.get("table1")),
        "captures": page_captures.read(files.capture_file, files.answers, settings.supervisor),
        "histories": _histories(settings, files),
        "time": page_tables.build("time", "Time and memory of each kind of job", time) if len(time) else None,
        "machine": machine(files.provenance),
        "configuration": settings.configuration,
        "configuration_link": pictures.of_text(settings.configuration),
    }
    script = (resources.files(__package__) / "page.js").read_text(encoding="utf-8")
    return pictures.render(__package__, "page.html", **sections, plotly=get_plotlyjs(), js=script)


def _draw_answer(
    path: Path, settings: ReportJob, first_table: tuple[str, pandas.DataFrame], verdicts: pandas.DataFrame
) -> None:
    """Draw the main comparisons and the accuracies of the study's first table, by its supervisor."""
    table, rows = first_table
    lenses = rows[(rows["elements"] != "") & (rows["classifier"] == settings.supervisor)]
    main = verdicts[verdicts["claim"].isin(settings.questions) & (verdicts["table"] == table)]
    main = main[main["classifier"].str.split("-").str[0] == settings.supervisor]  # also restored
    answer_figure.draw(path, main, lenses, settings.by_task, float(lenses["reference_accuracy"].mean()))


def _of_earlier_lenses(path: Path, lenses: Mapping[str, Path]) -> str:
    """Return a warning if an optional table is older than some lenses, since no target updates it; else ""."""
    later = [lens for lens, file in lenses.items() if file.stat().st_mtime > path.stat().st_mtime]
    return f" Older than these lenses, so maybe of earlier ones: {', '.join(later)}." if later else ""


def _table(name: str, frame: pandas.DataFrame, note: str = "") -> page_tables.Table:
    spread = _SPREAD if any(str(column).endswith(STD) for column in frame) else ""
    return page_tables.build(name, title(name), frame, spread + note)


def _charts(
    settings: ReportJob,
    elements: Iterable[str],
    frames: Mapping[str, pandas.DataFrame],
    by_seed: pandas.DataFrame | None,
) -> list[page_charts.Chart]:
    """Return the charts of accuracies in table 1, over the RMS spot and the radius, and of further comparisons.

    Args:
        by_seed: rows of table 1 by seed, if the study has it.
    """
    drawn: list[page_charts.Chart | None] = []
    if by_seed is not None:
        drawn.append(page_charts.accuracy_over_rms(frames["table1"]))
        radii = settings.radii, settings.design_radii
        drawn += [page_charts.accuracy_by_radius(name, by_seed, *radii) for name in elements]
    if "tolerances_compared" in frames and len(losses := frames["tolerances_compared"]):
        labels = [f"{row['lens']} − {row['baseline']}" for row in losses.to_dict("records")]
        drawn.append(
            page_charts.differences("tolerances", "What is lost in manufacture, task less image", losses, labels)
        )
    ablations = [frame for name, frame in frames.items() if name.startswith("ablation_")]
    if ablations:
        variants = pandas.concat(ablations).dropna(subset=["difference"])
        heading = "Ablations: variant less base"
        drawn.append(page_charts.differences("ablations", heading, variants, variants["lens"].tolist()))
    return [chart for chart in drawn if chart is not None]


def _histories(settings: ReportJob, files: PageFiles) -> list[page_charts.Chart]:
    """Return the charts of the design histories, by elements, and of the training of the restoration networks."""
    histories = dict(zip(settings.elements, map(_read, files.histories), strict=True))
    drawn = []
    for elements in dict.fromkeys(settings.elements.values()):
        runs = {lens: _last_part(run) for lens, run in histories.items() if settings.elements[lens] == elements}
        description = f"RMS spot radius during the last stage of the design of each {elements}."
        heading = f"Design of each {elements}: RMS spot"
        drawn.append(
            page_charts.histories(f"rms-{elements}", heading, "rms_um", "RMS spot [um]", runs, description, True)
        )
        runs = {lens: run for lens, run in runs.items() if lens in settings.by_classifier}
        description = (
            f"Loss of the classifier on fixed images during the design of each {elements}. The lens with the smallest "
            "loss is kept."
        )
        heading = f"Design of each {elements}: loss of the classifier"
        drawn.append(
            page_charts.histories(f"loss-{elements}", heading, "validation_loss", "loss", runs, description, False)
        )
    runs = dict(zip(settings.restored, map(_read, files.restorations), strict=True))
    description = "PSNR on minival images during the training of the restoration networks."
    drawn.append(
        page_charts.histories("history-restoration", "Restoration", "psnr_db", "PSNR [dB]", runs, description, False)
    )
    return [chart for chart in drawn if chart is not None]


def _read(path: Path) -> pandas.DataFrame:
    """Read a history; it is empty for an imported lens."""
    return read_table(path) if path.read_text(encoding="utf-8").strip() else pandas.DataFrame()


def _last_part(history: pandas.DataFrame) -> pandas.DataFrame:
    """Return the last phase of a descent, or the smallest RMS spot so far of a search from many starts."""
    if "phase" in history:
        return history[history["phase"] == history["phase"].iloc[-1]].reset_index(drop=True)
    return history.assign(rms_um=history["rms_um"].cummin()) if "start" in history else history


def durations(folder: Path) -> pandas.DataFrame:
    """Return a row per kind of job from Snakemake's benchmark files: jobs, time [min], longest job, memory [MB]."""
    rows = [
        {"job": rule.replace("_", " "), "minutes": job.seconds / 60, "memory_mb": job.memory_mb or math.nan}
        for rule, job in benchmarks(folder)
    ]
    if not rows:
        return pandas.DataFrame()
    minutes = {
        f"{name}_min": ("minutes", how) for name, how in (("total", "sum"), ("mean", "mean"), ("longest", "max"))
    }
    table = (
        pandas.DataFrame(rows).groupby("job").agg(jobs=("minutes", "size"), **minutes, memory_mb=("memory_mb", "max"))
    )
    return table.sort_values("total_min", ascending=False).reset_index()


def machine(provenance: Sequence[Path]) -> list[tuple[str, str]]:
    """Return facts about the machine that makes the page, and commits and versions that made the tables."""
    entries = [
        ("machine", f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}"),
        ("Python", platform.python_version()),
    ]
    contents = [read_json(path) for path in provenance]
    commits = dict.fromkeys(content["commit"] for content in contents)
    versions: dict[str, dict[str, None]] = {}
    for content in contents:
        for package, version in content["versions"].items():
            versions.setdefault(package, {})[version] = None
    entries += [("commit of the tables", ", ".join(commits))] if commits else []
    return entries + [(package, ", ".join(numbers)) for package, numbers in versions.items()]


def table_name(table: Path) -> str:
    """Return the name of a table from that of its file."""
    return table.stem.replace(".", "_")
