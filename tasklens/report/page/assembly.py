"""Assembly of the page from the files of a study: the answer in words first, and what is missing."""

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import pandas
from jinja2 import Environment, PackageLoader, StrictUndefined
from plotly.offline import get_plotlyjs

from tasklens.report.headings import STD
from tasklens.report.optimality import Optimum, optimum
from tasklens.report.page import captures, charts, gallery, machine, pictures, tables, words
from tasklens.runtime import yaml_files
from tasklens.runtime.files import FileError, Files, damaged, read_table, write_text
from tasklens.study.settings import Slice

LARGEST_MB = 15.0
_CAPTIONS = {
    "table1": "Table 1: accuracy, image quality and spot size of each lens",
    "table2": "Table 2: accuracy with other classifiers",
    "table3": "Table 3: task-driven against end-to-end design",
    "table4": "Table 4: after image restoration",
    "verdicts": "Verdicts on the paper's claims",
    "psf_tail": "Tails of the PSFs about the chief ray: core of 50 % of the light, and what is outside it",
    "effort": "Effort of each design: lenses tried, and minutes of one core",
    "regimes": "Where it pays: task-driven lens minus the best imaging lens",
    "tolerances": "Built lenses: what each design loses in manufacture",
    "tolerances_compared": "What a task-driven lens loses in manufacture minus what an imaging lens loses [points]",
    "tasks": "Other tasks: scores of their networks through each lens",
    "merit_function": "Merit functions: what each classifier wants of a lens, by spatial frequency [cycles per pixel]",
}
_SPREAD = " ± is the standard deviation over seeds."


def make(settings: Slice, inputs: Files, outputs: Files) -> None:
    """Write the page.

    Raises:
        FileError: it is larger than 15 MB.
    """
    page = render(settings, inputs)
    size_mb = len(page.encode()) / 1e6
    if size_mb > LARGEST_MB:
        raise FileError(f"{outputs.report}: would have {size_mb:.1f} MB, more than {LARGEST_MB:.0f}: show fewer lenses")
    write_text(outputs.report, page)


def render(settings: Slice, inputs: Files) -> str:
    """Return the page as HTML."""
    frames = {name: read_table(path) for name, path in (inputs.tables | inputs.others).items()}
    frames |= {name: read_table(path) for name, path in settings.optional.items() if path.exists()}
    _check_tails(settings, inputs, frames)
    table1 = frames.get("table1")
    shown = captures.shown(inputs.captures, settings.supervisor)
    time = machine.durations(settings.benchmarks)
    sections: dict[str, Any] = {
        "study": settings.study,
        "seeds": settings.seeds,
        "supervisor": settings.supervisor,
        "summary": _summary(settings, frames),
        "answers": _answers(settings, frames),
        "best": {} if table1 is None else words.best_lenses(table1, settings.by_task),
        "convergence": words.convergence(_optima(settings, inputs)),
        "missing": missing(settings, inputs),
        "optional": [name for name in settings.optional if name not in frames],
        "tables": [_table(name, frames[name]) for name in settings.tables if name in frames],
        "verdicts": _table("verdicts", frames["verdicts"]) if "verdicts" in frames else None,
        "more": [_table(name, frame) for name, frame in frames.items() if name in ("psf_tail", "effort")],
        "further": [
            _table(name, frames[name], _of_earlier_lenses(path, inputs))
            for name, path in settings.optional.items()
            if name in frames
        ],
        "drawn": {name: pictures.link(path) for name, path in settings.optional_figures.items() if path.exists()},
        "accuracy": None if table1 is None else charts.accuracy_over_rms(table1),
        "comparisons": _comparisons(settings, frames),
        "gallery": gallery.entries(settings, inputs, table1),
        "captures": shown,
        "histories": _histories(settings, inputs),
        "time": tables.build("time", "Time and memory of each kind of job", time) if len(time) else None,
        "machine": machine.facts(inputs.provenance),
        "configuration": settings.configuration,
        "configuration_link": pictures.of_text(settings.configuration),
    }
    folder = resources.files(__package__)
    parts = {name: (folder / f"page.{name}").read_text(encoding="utf-8") for name in ("css", "js")}
    environment = Environment(
        loader=PackageLoader(__package__, "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("page.html").render(sections, plotly=get_plotlyjs(), **parts)


def missing(settings: Slice, inputs: Files) -> list[str]:
    """Say what of the study has not been made yet."""
    found = [f"{name} has not been made" for name in settings.tables if name not in inputs.tables]
    others = {"verdicts": "verdicts have", "psf_tail": "the table of tails has", "effort": "the table of efforts has"}
    found += [f"{said} not been made" for name, said in others.items() if name not in inputs.others]
    groups = {"lenses": "not designed", "page": "without certificate and drawings", "histories": "without history"}
    for group, said in groups.items():
        known = settings.elements if group == "lenses" else inputs.lenses  # a lens is missing once
        absent = [lens for lens in known if lens not in getattr(inputs, group)]
        if absent:
            found.append(f"{len(absent)} of {len(known)} lenses are {said}: {', '.join(absent)}")
    if "images" not in inputs.captures:
        found.append("captures have not been rendered")
    return found


def _check_tails(settings: Slice, inputs: Files, frames: Mapping[str, pandas.DataFrame]) -> None:
    """Raise FileError where the table of tails lacks a lens, unless it is one of what is there."""
    if "psf_tail" not in frames or inputs.others["psf_tail"].stem.endswith("-partial"):
        return
    if lost := set(settings.elements) - set(frames["psf_tail"]["lens"]):
        raise damaged(inputs.others["psf_tail"], f"without {', '.join(sorted(lost))}")


def _summary(settings: Slice, frames: Mapping[str, pandas.DataFrame]) -> list[words.Sentence]:
    if "verdicts" not in frames:
        return [words.Sentence("There are no verdicts yet: not all lenses that they compare have been measured.")]
    return words.summary(frames["verdicts"], settings.margins, len(settings.seeds))


def _answers(settings: Slice, frames: Mapping[str, pandas.DataFrame]) -> dict[str, list[words.Sentence]]:
    if "verdicts" not in frames:
        return {}
    elements = dict.fromkeys(settings.elements.values())
    return words.answers(frames["verdicts"], elements, settings.questions, settings.margins)


def _optima(settings: Slice, inputs: Files) -> dict[str, Optimum]:
    """Return the test of the optimum of each supervised lens in the first seed."""
    there = [lens for lens in settings.supervised if lens in inputs.lenses]  # not all, of a study that still runs
    tests = {lens: optimum(yaml_files.read(inputs.lenses[lens])) for lens in there}
    return {lens: test for lens, test in tests.items() if test is not None}


def _of_earlier_lenses(path: Path, inputs: Files) -> str:
    """Say so if a lens has been designed after an optional table was made, which no target makes again by itself."""
    later = [lens for lens, file in inputs.lenses.items() if file.stat().st_mtime > path.stat().st_mtime]
    return f" Older than these lenses, so maybe of earlier ones: {', '.join(later)}." if later else ""


def _table(name: str, frame: pandas.DataFrame, note: str = "") -> tables.Table:
    caption = _CAPTIONS.get(name) or f"Ablation: {name.removeprefix('ablation_').replace('_', ' ')}"
    spread = _SPREAD if any(str(column).endswith(STD) for column in frame) else ""
    return tables.build(name, caption, frame, spread + note)


def _comparisons(settings: Slice, frames: Mapping[str, pandas.DataFrame]) -> list[charts.Chart]:
    """Return the charts of differences: main questions, regimes, tolerances, ablations."""
    found = []
    if "verdicts" in frames:
        verdicts = frames["verdicts"]
        main = verdicts[verdicts["claim"].isin(settings.questions) & (verdicts["table"] == "table1")]
        labels = [f"{row['lens']} − {row['baseline']}" for row in main.to_dict("records")]
        found.append(charts.differences("questions", "Task-driven lenses against others", main, labels))
    if "regimes" in frames:
        regimes = frames["regimes"]
        labels = [
            f"{row['elements']} {row['design']}, F/{row['f_number']:g}, {row['field_of_view_deg']:g}°"
            for row in regimes.to_dict("records")
        ]
        for name, rows in regimes.groupby("design", sort=False):
            found.append(charts.regime_map(f"regime-map-{name}", f"Where {name} pays", rows))
        found.append(charts.differences("regimes-differences", "Where it pays, with intervals", regimes, labels))
    if "tolerances_compared" in frames and len(compared := frames["tolerances_compared"]):
        labels = [f"{row['lens']} − {row['baseline']}" for row in compared.to_dict("records")]
        found.append(charts.differences("tolerances", "What is lost in manufacture, task less image", compared, labels))
    ablations = [frame for name, frame in frames.items() if name.startswith("ablation_")]
    if ablations:
        both = pandas.concat(ablations).dropna(subset=["difference"])
        found.append(charts.differences("ablations", "Ablations: variant less base", both, both["lens"].tolist()))
    return [chart for chart in found if chart is not None]


def _histories(settings: Slice, inputs: Files) -> list[charts.Chart]:
    """Return the charts of designs, by elements, and of trainings of the restoration."""
    found = []
    for elements in dict.fromkeys(settings.elements.values()):
        lenses = [lens for lens, own in settings.elements.items() if own == elements and lens in inputs.histories]
        runs = {lens: _last_part(_read(inputs.histories[lens])) for lens in lenses}
        said = f"RMS spot radius in the last part of the design of each {elements}. {_ends(runs, 'rms_um')}"
        title = f"Design of each {elements}: RMS spot"
        found.append(charts.histories(f"rms-{elements}", title, "rms_um", "RMS spot [um]", runs, said, True))
        runs = {lens: run for lens, run in runs.items() if lens in settings.by_classifier}
        said = (
            f"Loss of the classifier on the fixed images of the design of each {elements}, which ends with the lens of "
            f"the least one. {_ends(runs, 'validation_loss')}"
        )
        title = f"Design of each {elements}: loss of the classifier"
        found.append(charts.histories(f"loss-{elements}", title, "validation_loss", "loss", runs, said, False))
    runs = {lens: _read(path) for lens, path in inputs.restorations.items()}
    said = f"PSNR on minival while the restoration networks are trained. {_ends(runs, 'psnr_db')}"
    found.append(charts.histories("history-restoration", "Restoration", "psnr_db", "PSNR [dB]", runs, said, False))
    return [chart for chart in found if chart is not None]


def _read(path: Path) -> pandas.DataFrame:
    """Read a history, which is empty for an imported lens."""
    return read_table(path) if path.read_text().strip() else pandas.DataFrame()


def _last_part(history: pandas.DataFrame) -> pandas.DataFrame:
    """Return the last phase of a descent; of a search from many starts the least RMS spot so far."""
    if "phase" in history:
        return history[history["phase"] == history["phase"].iloc[-1]].reset_index(drop=True)
    return history.assign(rms_um=history["rms_um"].cummin()) if "start" in history else history


def _ends(runs: Mapping[str, pandas.DataFrame], column: str) -> str:
    """Say the last value of each run."""
    ends = {name: run[column].dropna() for name, run in runs.items() if column in run}
    said = "; ".join(f"{name} {values.iloc[-1]:.4g}" for name, values in ends.items() if len(values))
    return f"Last values: {said}." if said else ""
