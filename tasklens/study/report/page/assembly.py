"""Assembly of the page from the files of a study; the answer in words comes first."""

from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import pandas
from jinja2 import Environment, PackageLoader, StrictUndefined
from plotly.offline import get_plotlyjs

from tasklens.runtime import yaml_files
from tasklens.runtime.files import FileError, damaged, read_table, write_text
from tasklens.show import pictures
from tasklens.show.headings import STD
from tasklens.show.optimality import Optimum, optimum
from tasklens.study.report import answer as answer_figure
from tasklens.study.report.page import captures, charts, gallery, machine, tables, words
from tasklens.study.report.page.page_files import PageFiles, RuleFiles
from tasklens.study.report_jobs import ReportJob

LARGEST_MB = 15.0
_CAPTIONS = {
    "table1": "Table 1: accuracy, image quality and spot size of each lens",
    "table2": "Table 2: accuracy with other classifiers",
    "table3": "Table 3: task-driven against end-to-end design",
    "table4": "Table 4: after image restoration",
    "verdicts": "Verdicts on the paper's claims",
    "psf_tail": "Tails of the PSFs: core (50 % of the light about the chief ray) and light outside three core radii",
    "effort": "Effort of each design: lens evaluations, and wall time",
    "tolerances": "Built lenses: what each design loses in manufacture",
    "tolerances_compared": "What a task-driven lens loses in manufacture minus what an imaging lens loses [points]",
    "tasks": "Other tasks: scores of their networks through each lens",
    "merit_function": "Merit functions: weight of each spatial frequency [cycles per pixel] for each classifier",
}
_SPREAD = " ± is the standard deviation over seeds."


def make(settings: ReportJob, inputs: RuleFiles, report: Path, answer: Path) -> None:
    """Write the page, and the figure of its answer.

    Raises:
        FileError: the page is larger than 15 MB.
    """
    files = PageFiles.of(settings, inputs)
    _draw_answer(answer, settings, files)
    page = render(settings, files, answer)
    size_mb = len(page.encode()) / 1e6
    if size_mb > LARGEST_MB:
        raise FileError(f"{report}: would have {size_mb:.1f} MB, more than {LARGEST_MB:.0f}: show fewer lenses")
    write_text(report, page)


def render(settings: ReportJob, files: PageFiles, answer: Path) -> str:
    """Return the page as HTML; `answer` is the figure of its answer."""
    frames = {name: read_table(path) for name, path in {**files.tables, **files.others, **files.optional}.items()}
    _check_tails(settings, files, frames)
    table1 = frames.get("table1")
    by_seed = {name: read_table(path) for name, path in files.by_seed.items()}
    elements = dict.fromkeys(settings.elements.values())
    time = machine.durations(files.benchmarks)
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
        "convergence": words.convergence(_optima(settings, files)),
        "optional": [name for name in files.optional_names if name not in frames],
        "tables": [_table(name, frames[name]) for name in settings.tables],
        "verdicts": _table("verdicts", frames["verdicts"]),
        "more": [_table(name, frames[name]) for name in ("psf_tail", "effort")],
        "further": [
            _table(name, frames[name], _of_earlier_lenses(path, files)) for name, path in files.optional.items()
        ],
        "drawn": {name: pictures.link(path) for name, path in files.drawn.items()},
        "accuracy": None if table1 is None else charts.accuracy_over_rms(table1),
        "by_field": _by_radius(settings, elements, by_seed),
        "comparisons": _comparisons(frames),
        "gallery": gallery.entries(settings, files, by_seed.get("table1")),
        "captures": captures.read(files.captures, files.answers, settings.supervisor),
        "histories": _histories(settings, files),
        "time": tables.build("time", "Time and memory of each kind of job", time) if len(time) else None,
        "machine": machine.facts(files.provenance),
        "configuration": settings.configuration,
        "configuration_link": pictures.of_text(settings.configuration),
    }
    script = (resources.files(__package__) / "page.js").read_text(encoding="utf-8")
    environment = Environment(
        loader=PackageLoader(__package__, "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("page.html").render(
        sections, plotly=get_plotlyjs(), css=pictures.style_sheet(), js=script
    )


def _draw_answer(path: Path, settings: ReportJob, files: PageFiles) -> None:
    """Draw the main comparisons and the accuracies of the study's first table, by its supervisor."""
    table, by_seed = next(iter(files.by_seed.items()))
    rows, verdicts = read_table(by_seed), read_table(files.others["verdicts"])
    lenses = rows[(rows["elements"] != "") & (rows["classifier"] == settings.supervisor)]
    main = verdicts[verdicts["claim"].isin(settings.questions) & (verdicts["table"] == table)]
    main = main[main["classifier"].str.split("-").str[0] == settings.supervisor]  # also restored
    answer_figure.draw(path, main, lenses, settings.by_task, float(lenses["reference_accuracy"].mean()))


def _check_tails(settings: ReportJob, files: PageFiles, frames: Mapping[str, pandas.DataFrame]) -> None:
    """Raise FileError if a lens is missing from the table of tails."""
    if missing := set(settings.elements) - set(frames["psf_tail"]["lens"]):
        raise damaged(files.others["psf_tail"], f"without {', '.join(sorted(missing))}")


def _optima(settings: ReportJob, files: PageFiles) -> dict[str, Optimum]:
    """Return the test for a local optimum of each lens that has one, for the first seed."""
    tests = {lens: optimum(yaml_files.read(files.lenses[lens])) for lens in settings.with_optimum}
    return {lens: test for lens, test in tests.items() if test is not None}


def _of_earlier_lenses(path: Path, files: PageFiles) -> str:
    """Return a warning if an optional table is older than some lenses, since no target updates it; else ""."""
    later = [lens for lens, file in files.lenses.items() if file.stat().st_mtime > path.stat().st_mtime]
    return f" Older than these lenses, so maybe of earlier ones: {', '.join(later)}." if later else ""


def _table(name: str, frame: pandas.DataFrame, note: str = "") -> tables.Table:
    caption = _CAPTIONS.get(name) or f"Ablation: {name.removeprefix('ablation_').replace('_', ' ')}"
    spread = _SPREAD if any(str(column).endswith(STD) for column in frame) else ""
    return tables.build(name, caption, frame, spread + note)


def _by_radius(
    settings: ReportJob, elements: Iterable[str], by_seed: Mapping[str, pandas.DataFrame]
) -> list[charts.Chart]:
    """Return the charts of accuracy over the radius in table 1, one for each name of elements."""
    if "table1" not in by_seed:
        return []
    radii = settings.radii, settings.design_radii
    by_elements = [charts.accuracy_by_radius(name, by_seed["table1"], *radii) for name in elements]
    return [chart for chart in by_elements if chart is not None]


def _comparisons(frames: Mapping[str, pandas.DataFrame]) -> list[charts.Chart]:
    """Return the charts of differences: tolerances and ablations."""
    comparisons: list[charts.Chart | None] = []
    if "tolerances_compared" in frames and len(losses := frames["tolerances_compared"]):
        labels = [f"{row['lens']} − {row['baseline']}" for row in losses.to_dict("records")]
        comparisons.append(
            charts.differences("tolerances", "What is lost in manufacture, task less image", losses, labels)
        )
    ablations = [frame for name, frame in frames.items() if name.startswith("ablation_")]
    if ablations:
        variants = pandas.concat(ablations).dropna(subset=["difference"])
        comparisons.append(
            charts.differences("ablations", "Ablations: variant less base", variants, variants["lens"].tolist())
        )
    return [chart for chart in comparisons if chart is not None]


def _histories(settings: ReportJob, files: PageFiles) -> list[charts.Chart]:
    """Return the charts of the design histories, by elements, and of the training of the restoration networks."""
    history_charts = []
    for elements in dict.fromkeys(settings.elements.values()):
        lenses = [lens for lens, lens_elements in settings.elements.items() if lens_elements == elements]
        runs = {lens: _last_part(_read(files.histories[lens])) for lens in lenses}
        description = f"RMS spot radius during the last stage of the design of each {elements}. {_ends(runs, 'rms_um')}"
        title = f"Design of each {elements}: RMS spot"
        history_charts.append(
            charts.histories(f"rms-{elements}", title, "rms_um", "RMS spot [um]", runs, description, True)
        )
        runs = {lens: run for lens, run in runs.items() if lens in settings.by_classifier}
        description = (
            f"Loss of the classifier on fixed images during the design of each {elements}. The lens with the smallest "
            f"loss is kept. {_ends(runs, 'validation_loss')}"
        )
        title = f"Design of each {elements}: loss of the classifier"
        history_charts.append(
            charts.histories(f"loss-{elements}", title, "validation_loss", "loss", runs, description, False)
        )
    runs = {lens: _read(path) for lens, path in files.restorations.items()}
    description = f"PSNR on minival images during the training of the restoration networks. {_ends(runs, 'psnr_db')}"
    history_charts.append(
        charts.histories("history-restoration", "Restoration", "psnr_db", "PSNR [dB]", runs, description, False)
    )
    return [chart for chart in history_charts if chart is not None]


def _read(path: Path) -> pandas.DataFrame:
    """Read a history; it is empty for an imported lens."""
    return read_table(path) if path.read_text(encoding="utf-8").strip() else pandas.DataFrame()


def _last_part(history: pandas.DataFrame) -> pandas.DataFrame:
    """Return the last phase of a descent, or the smallest RMS spot so far of a search from many starts."""
    if "phase" in history:
        return history[history["phase"] == history["phase"].iloc[-1]].reset_index(drop=True)
    return history.assign(rms_um=history["rms_um"].cummin()) if "start" in history else history


def _ends(runs: Mapping[str, pandas.DataFrame], column: str) -> str:
    """List the last value of each run in a sentence."""
    ends = {name: run[column].dropna() for name, run in runs.items() if column in run}
    listing = "; ".join(f"{name} {values.iloc[-1]:.4g}" for name, values in ends.items() if len(values))
    return f"Last values: {listing}." if listing else ""
