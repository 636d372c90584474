"""Start and end of a run: consent, checks, the terminal."""

import subprocess
import sys
import tempfile
from pathlib import Path

from tasklens.pipeline import changes, closing, planning
from tasklens.pipeline.terminal import Terminal
from tasklens.recognition import class_folders
from tasklens.runtime import files
from tasklens.runtime.errors import InputError


def planned_by_study():
    """Return the jobs of this run by label, of each study."""
    planned = {}
    for job in snakemake_internals.planned_jobs(workflow):
        if job.remains:
            planned.setdefault(job.study, {})[job.label] = job
    return planned


def words_of_dry_run():
    """Return why the run would be refused; with `--config plan=FILE` its jobs are written to that file."""
    if PLAN is not None:
        files.write_text(Path(PLAN), planning.dump(snakemake_internals.planned_jobs(workflow)))
    return refusals(overwritten(planned_by_study()))


def overwritten(planned):
    """Return the finished results that the planned jobs of each study overwrite."""
    return {name: changes.overwritten(study_named(name), jobs) for name, jobs in planned.items()}


def refusals(overwritten):
    """Return why this run must not start: changed values would overwrite finished results; else an empty text."""
    cores = snakemake_internals.cores(workflow)
    texts = [changes.refusal(found, name, durations_in(name), cores) for name, found in overwritten.items()]
    return "" if OVERWRITE else "\n\n".join(filter(None, texts))


def check_studies(planned):
    """Check what the planned jobs read, and compile the tracer before jobs do; ends the run if something is wrong."""
    needed = {}  # rules by study, of which the points of a sweep are one
    for name, jobs in planned.items():
        study = STUDY if name in (point.name for point in POINTS) else study_named(name.partition("/")[0])
        needed.setdefault(study.name, set()).update(job.rule for job in jobs.values())
    try:
        for name, names_of_rules in needed.items():
            study, networks = study_named(name), bool(names_of_rules & {"reference", "task_reference"})
            if "images" in names_of_rules:
                class_folders.check(study.images)
            if networks or study.imported or "design" in names_of_rules:
                check_in_own_process(study, ["--networks"] if networks else [])
    except InputError as error:
        sys.exit(f"{error}")


def check_in_own_process(study, options):
    """Check a study where torch is imported; ends the run with the status of the check, which has said why."""
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        file.write(loading.dump(study))
        file.flush()
        command = [sys.executable, "-m", "tasklens.cli", "study", "check", file.name, "--no-weights", *options]
        if status := subprocess.run(command, stdout=subprocess.DEVNULL).returncode:
            sys.exit(status)


if snakemake_internals.is_main(workflow):
    if snakemake_internals.is_dry_run(workflow):
        snakemake_internals.after_dry_run(words_of_dry_run)
    else:
        terminal = Terminal(STUDY, study_named, snakemake_internals.is_quiet(workflow))


onstart:
    snakemake_internals.terminate_safely()
    snakemake_internals.limit_no_rate(workflow)
    planned, cores = planned_by_study(), snakemake_internals.cores(workflow)
    found = overwritten(planned)
    if reason := refusals(found):
        sys.exit(reason)
    check_studies(planned)
    for name, jobs in planned.items():
        if found[name].otherwise:
            amount = changes.amount(found[name].otherwise, durations_in(name), cores)
            print(f"Changed code or input files: {amount}")
        if name != owner(name):
            continue  # the pages of its parts take seconds
        print(durations_in(name).forecast([job.rule for job in jobs.values()], cores))
        files.write_if_changed(Path("results", name, "study.yaml"), loading.dump(study_named(name)))  # for people
    terminal.begin(planned, cores)


onsuccess:
    terminal.end()
    print(closing.success(STUDY, terminal.runs))


onerror:
    terminal.end()
    print(closing.failure(terminal.runs))
