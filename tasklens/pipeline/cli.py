"""Command line of TaskLens; the rules of the workflow call the same commands.

    tasklens design config/config.yaml doublet-tasklens --seed 0

Files are read and written below results/<study name>/. Only commands that need torch import it.
"""

import argparse
import os
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from tasklens.pipeline import report_jobs
from tasklens.pipeline.partial import prepare
from tasklens.pipeline.run import run
from tasklens.pipeline.stage import SEED, STAGES, Stage
from tasklens.runtime.errors import InputError
from tasklens.study.loading import load
from tasklens.study.names import SHARP
from tasklens.study.study import TABLES

_HELP: dict[str, dict[str, Any]] = {
    "study": {"type": Path, "help": "study file (YAML)"},
    "lens": {"help": f"name of a lens; {SHARP} for the sharp images, where a classifier follows"},
    "measured_name": {"help": "name of a classifier, with -restored on restored captures"},
    "table": {"choices": TABLES},
    "classifier": {"help": "name of a classifier"},
    "elements": {"help": "name of elements, such as doublet"},
    "ablation": {"help": "name of an ablation"},
}


def check(args: argparse.Namespace) -> None:
    """Check a study file and its imported lenses, compile the tracer where it is not yet, and print a summary."""
    from tasklens.optics.tracing.trace import compile_tracer

    study = load(args.study)
    compile_tracer()
    if study.imported:
        from tasklens.design import imported
        from tasklens.optics.view import view_of_spec

        for entry in study.imported.values():
            spec = study.spec_of(entry.elements)
            imported.fit(entry, view_of_spec(spec), spec.f_number, study.evaluation_rays)
    if args.networks:
        from tasklens.recognition import classifiers

        for name, classifier in study.classifiers.items():
            classifiers.check(name, classifier, study.images.size)
        for name, design in study.designs.items():
            if size := getattr(design, "size", None):
                classifiers.check(f"{study.supervisor} for designs.{name}", study.classifiers[study.supervisor], size)
    print(f"{study.name}: {len(study.lenses)} lenses, {len(study.classifiers)} classifiers, seeds {list(study.seeds)}")


def analyse(args: argparse.Namespace) -> None:
    """Compute and print the table of a lens from its file: figures by field and aberrations by surface."""
    from tasklens.optics.analysis.datasheet import figures, seidel_by_surface, view_of
    from tasklens.optics.io import prescription
    from tasklens.report import certificate

    found, content = prescription.read(args.file)
    lens = found.lens
    view = view_of(lens, content, str(args.file))
    computed = content | {"figures": figures(lens, view, args.rays)}
    print(certificate.markdown(str(args.file), view.fields.tolist(), computed, seidel_by_surface(lens, view)), end="")


def _run_stage(stage: Stage, args: argparse.Namespace) -> int:
    study = load(args.study)
    wildcards = {name: getattr(args, name) for name in stage.wildcards}
    if wildcards.get(SEED, 0) is None:
        wildcards[SEED] = study.seeds[0]
    partial = getattr(args, "partial", False)
    if partial and stage is report_jobs.report:
        prepare(study)
    return run(stage, study, wildcards, partial) or 0


def _count(text: str) -> int:
    """Parse a positive integer; raises ArgumentTypeError."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number above zero, got {text!r}")
    return int(text)


def _parser() -> argparse.ArgumentParser:
    """Build the parser: a subcommand for every stage, with its wildcards as arguments, and two that are no stage."""
    top = argparse.ArgumentParser(prog="tasklens", description=(__doc__ or "").splitlines()[0])
    commands = top.add_subparsers(required=True, metavar="command")

    def command(name: str, meaning: str | None, function: Callable[..., Any], *words: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name.replace("_", "-"), help=meaning, description=meaning)
        added.set_defaults(run=function)
        for word in words:
            added.add_argument(word, **_HELP.get(word, {}))
        return added

    for stage in STAGES.values():
        words = [name for name in stage.wildcards if name != SEED]
        added = command(stage.name, stage.plan.__doc__, partial(_run_stage, stage), "study", *words)
        if SEED in stage.wildcards:
            added.add_argument("--seed", type=int, help="by default the first seed of the study")
        if stage in (report_jobs.table, report_jobs.report):
            added.add_argument("--partial", action="store_true", help=f"write <{stage.name}>-partial, of what is there")
    added = command("check", check.__doc__, check, "study")
    added.add_argument("--networks", action="store_true", help="build every classifier once, without weights")
    added = command("analyse", analyse.__doc__, analyse)
    added.add_argument("file", type=Path, help="lens file (YAML) with its spec")
    added.add_argument("--rays", type=_count, default=4096, help="per field and colour")
    return top


def main(argv: list[str] | None = None) -> int:
    """Run one command; return exit status 2 for a user error, 1 for a failed `verify`, else 0.

    As a program, without `argv`, it does not return: the process ends without freeing every object, which takes longer
    than some jobs. All files are complete then.
    """
    args = _parser().parse_args(argv)
    # torch causes this warning itself, at the first forward-mode derivative of a process.
    warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", FutureWarning)
    try:
        status = args.run(args) or 0
    except (InputError, FileNotFoundError, FloatingPointError) as error:
        print(f"tasklens: {error}", file=sys.stderr)
        status = 2
    if argv is None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


if __name__ == "__main__":
    main()
