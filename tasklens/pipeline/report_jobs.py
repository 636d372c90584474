"""Declaration of the jobs that tell the results of a study: tables, verdicts, report, verification."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tasklens.pipeline.figure_jobs import captures, certificate
from tasklens.pipeline.jobs import (
    STAGES,
    design,
    lens_file,
    measurement,
    production,
    psf_file,
    reproduce,
    restore,
    task_fine_tune,
)
from tasklens.pipeline.stage import Plan, results, stage
from tasklens.study import claims as paper_claims
from tasklens.study import effort as paper_effort
from tasklens.study import names
from tasklens.study import tables as paper_tables
from tasklens.study.claims import Claims
from tasklens.study.loading import at_points, dump
from tasklens.study.names import SHARP
from tasklens.study.settings import Slice
from tasklens.study.study import Study
from tasklens.study.sweep import points

PAPER = Path(__file__).parents[1] / "report" / "paper.csv"  # the paper's values
REPORT = "tasklens.report"


def _lenses(study: Study, lenses: Iterable[str]) -> dict[str, Any]:
    """Return the files of lenses by (lens, seed)."""
    return {"lenses": {(lens, seed): lens_file(study, lens, seed) for lens in lenses for seed in study.seeds}}


def _measured(study: Study, measured: Iterable[tuple[str, str]], *outputs: str) -> dict[str, Any]:
    """Return outputs of measurements by (lens, measured name, seed); frozen losses of the supervisor alone."""
    keys = [(*pair, seed) for pair in measured for seed in study.seeds]
    return {
        name: {key: measurement(study, *key, name) for key in keys if name != "frozen" or key[1] == study.supervisor}
        for name in outputs
    }


def _claimed(study: Study, claims: Claims) -> dict[str, Any]:
    """Return the files of measurements that claims need."""
    lenses = dict.fromkeys(lens for claim in claims.claims for lens in claim.lenses)
    measured = dict.fromkeys((lens, claim.classifier) for claim in claims.claims for lens in claim.lenses)
    sharp = dict.fromkeys((SHARP, claim.reference) for claim in claims.claims if not claim.baselines)
    return _lenses(study, lenses) | _measured(study, measured | sharp, "metrics", "predictions")


def _published(name: str, *suffixes: str) -> dict[str, str]:
    """Return path patterns of the files of a table by suffix."""
    return {suffix.replace(".", "_"): f"tables/{name}.{suffix}" for suffix in (*suffixes, "csv", "md")}


@stage(f"{REPORT}.tables.make", _published("{table}", "seeds.csv", "tex", "json"))
def table(study: Study, table: str) -> Plan:
    """Make one table of the paper as CSV, Markdown and LaTeX."""
    contents = paper_tables.table(study, table)
    inputs = _lenses(study, contents.lenses) | _measured(study, contents.measured, "metrics", "frozen")
    return Plan(contents, inputs | {"paper": PAPER})


@stage(
    f"{STAGES}.psf_tail.run",
    _published("psf_tail", "fields.csv") | {"encircled_energy": "tables/encircled_energy.csv"},
)
def psf_tail(study: Study) -> Plan:
    """Make the tables of core, tail and encircled energy of all PSFs."""
    lenses = paper_tables.table_lenses(study)
    specs = {lens: study.spec_of(study.lens(lens).elements) for lens in lenses}
    settings = Slice(study=study.name, lenses=lenses, seeds=study.seeds, specs=specs, rays=study.evaluation_rays)
    return Plan(settings, _lenses(study, lenses))


@stage(f"{REPORT}.effort.make", {suffix: f"effort.{suffix}" for suffix in ("csv", "md")})
def effort(study: Study) -> Plan:
    """Make the table of the effort of each design: lenses tried, and core-minutes, which differ from run to run."""
    efforts = paper_effort.effort(study)
    settings = Slice(efforts=efforts, benchmark=design.benchmark(study))
    return Plan(settings, _lenses(study, efforts.lenses))


@stage(f"{REPORT}.verdicts.make", _published("verdicts"))
def verdicts(study: Study) -> Plan:
    """Make the table of verdicts on the paper's claims from the measured accuracies."""
    claims = paper_claims.claims(study)
    return Plan(claims, _claimed(study, claims))


@stage(f"{REPORT}.regimes.make", _published("regimes"))
def regimes(study: Study) -> Plan:
    """Make the table of the gain of task-driven design by element counts and specifications."""
    claims = paper_claims.regime_claims(study)
    lenses = {lens for claim in claims.claims for lens in (claim.lens, *claim.baselines)}
    tried = {lens: paper_effort.tried_in_all(study, lens) for lens in sorted(lenses)}
    return Plan(Slice(claims=claims, tried=tried), _claimed(study, claims))


@stage(f"{REPORT}.ablations.make", _published("ablation_{ablation}"))
def ablation(study: Study, ablation: str) -> Plan:
    """Make the table of one ablation: a design and its variants."""
    compared = paper_claims.ablation_claims(study, ablation)
    return Plan(compared, _claimed(study, compared.claims))


@stage(f"{REPORT}.tolerances.make", _published("tolerances") | {"compared_csv": "tables/tolerances-compared.csv"})
def tolerances(study: Study) -> Plan:
    """Make the table of built lenses: what each design loses in manufacture, compared with imaging lenses."""
    contents = paper_tables.built(study)
    lenses = {
        (lens, seed): production.output(study, "lenses", lens=lens, seed=seed)
        for lens in contents.lenses
        for seed in study.seeds
    }
    return Plan(contents, {"lenses": lenses})


@stage(
    f"{REPORT}.tasks.make",
    lambda study: _published("tasks") | {"psfs": "figures/tasks-psfs.png"} if study.tasks.networks else {},
)
def tasks(study: Study) -> Plan:
    """Make the table of tasks beside classification, scores of their networks through each lens, and draw its PSFs."""
    contents = paper_tables.tasks(study)
    metrics = {
        (lens, task, seed): task_fine_tune.output(study, "metrics", lens=lens, task=task, seed=seed)
        for lens in contents.lenses
        for task in contents.tasks
        for seed in study.seeds
    }
    drawn = [lens for lens in contents.lenses if lens != SHARP]
    inputs = {
        "metrics": metrics,
        "lenses": {lens: lens_file(study, lens, study.seeds[0]) for lens in drawn},
        "psfs": {lens: psf_file(study, lens, study.seeds[0]) for lens in drawn},
    }
    return Plan(contents, inputs)


@stage(f"{REPORT}.merit_function.make", _published("merit_function") | {"figure": "figures/merit_function.png"})
def merit_function(study: Study) -> Plan:
    """Make the table and figure of what each classifier wants of a lens: its loss as a function of the MTF."""
    contents = paper_tables.table(study, "table2" if "table2" in study.tables else "table1")
    lenses = [(lens, seed) for lens in contents.lenses for seed in contents.seeds]
    keys = [(lens, name, seed) for lens, seed in lenses for name in contents.classifiers]
    inputs = {
        "psfs": {lens: psf_file(study, *lens) for lens in lenses},
        "frozen": {key: measurement(study, *key, "frozen") for key in keys},
    }
    return Plan(Slice(contents=contents, supervisor=study.supervisor), inputs)


_LENS_PARTS = ("page", "zemax", "section", "spots", "psfs", "curves")  # of the certificate, in the report


@stage(f"{REPORT}.page.assembly.make", {"report": "report.html"})
def report(study: Study) -> Plan:
    """Make the page that tells the results of a study, from its tables, drawings, captures and benchmarks."""
    contents, seed = paper_tables.verification(study), study.seeds[0]
    lenses: dict[str, dict[str, Any]] = {lens: {"lens": lens, "seed": seed} for lens in contents.lenses}
    shown = [each.name for each in contents.tables]
    restored = [lens for lens, name in contents.measured if names.split(name)[1]]
    folder = Path(results(study))
    settings = Slice(
        study=study.name,
        seeds=study.seeds,
        supervisor=study.supervisor,
        tables=shown,
        elements={lens: study.lens(lens).elements for lens in lenses},
        by_task=[lens for lens in lenses if study.lens(lens).task_driven],
        by_classifier=[lens for lens in lenses if study.lens(lens).classified],
        margins={claim.text: claim.margin for claim in paper_claims.claims(study).claims},
        questions=[paper_claims.OVER_IMAGE_QUALITY, paper_claims.OVER_LEAST_SQUARES, paper_claims.FEWER_ELEMENTS],
        supervised=contents.supervised,
        optional={path.stem.replace("-", "_"): path for path in _optional(study)},
        optional_figures={"merit_function": merit_function.output(study, "figure")},
        benchmarks=folder / "benchmarks",
        configuration=dump(study),
    )
    inputs = {
        "tables": {name: table.output(study, "csv", table=name) for name in shown},
        "provenance": {name: table.output(study, "json", table=name) for name in shown},
        "others": {each.name: each.output(study, "csv") for each in (verdicts, psf_tail, effort)},
        "lenses": {lens: lens_file(study, lens, seed) for lens in lenses},
        "histories": {lens: design.output(study, "history", **lenses[lens]) for lens in lenses},
        **{part: {lens: certificate.output(study, part, **lenses[lens]) for lens in lenses} for part in _LENS_PARTS},
        "restorations": {lens: restore.output(study, "history", **lenses[lens]) for lens in restored},
        "captures": {name: captures.output(study, name) for name in ("images", "answers")},
    }
    return Plan(settings, inputs)


def _optional(study: Study) -> list[Path]:
    """Return the tables that the report shows where they exist, since they need further lenses."""
    stages = [stage.output(study, "csv") for stage in (regimes, merit_function, tolerances)]
    stages += [path for name, path in tasks.outputs(study).items() if name == "csv"]
    return [*stages, tolerances.output(study, "compared_csv")] + [
        ablation.output(study, "csv", ablation=name) for name in study.ablations
    ]


@stage(f"{REPORT}.sweep.make", lambda study: {kind: f"sweep.{kind}" for kind in ("csv", "md") if study.sweep})
def sweep(study: Study) -> Plan:
    """Make the table of a sweep: the numbers of all points beside each other."""
    studies = dict(zip(points(study.sweep), at_points(study), strict=True))
    tables = {
        point: {name: table.output(each, "csv", table=name) for name in each.tables} for point, each in studies.items()
    }
    return Plan(Slice(study=study.name, points=points(study.sweep)), {"tables": tables})


@stage(f"{REPORT}.verification.run", {})  # without output, it runs on every request
def verify(study: Study) -> Plan:
    """Verify limits and accuracies of a finished study; print failures and verdicts."""
    contents = paper_tables.verification(study)
    inputs = (
        _lenses(study, contents.lenses)
        | _measured(study, contents.measured, "metrics", "predictions")
        | {
            "reproduced": {
                (lens, name, seed): reproduce.output(study, "predictions", lens=lens, measured_name=name, seed=seed)
                for lens, name in contents.measured
                for seed in study.seeds
            },
            "tables": {each.name: table.output(study, "csv", table=each.name) for each in contents.tables},
            "verdicts": verdicts.output(study, "md"),
        }
    )
    return Plan(contents, inputs)
