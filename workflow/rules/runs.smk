"""Start and end of a run: consent, checks, the terminal."""

import subprocess
import sys
import tempfile
from pathlib import Path

from tasklens.study.run import changes, planning
from tasklens.recognition import class_folders
from tasklens.runtime import files
from tasklens.runtime.errors import InputError


@cache
def all_jobs():
    """Return the jobs that the targets need, also those that do not have to run."""
    return list(snakemake_internals.planned_jobs(workflow))


def planned_by_study():
    """Return the jobs of this run by label, of each study."""
    planned = {}
    for job in all_jobs():
        if job.remains:
            planned.setdefault(job.study, {})[job.label] = job
    return planned


def unrecorded():
    """Return why results would be taken for those of other settings, or an empty text."""
    jobs = {}
    for job in all_jobs():
        jobs.setdefault(job.study, []).append(job)
    return "\n\n".join(filter(None, (changes.find_unrecorded(study_named(name), jobs[name]) for name in jobs)))


def words_of_dry_run():
    """Return why the run would be refused; with `--config plan=FILE` write its jobs to that file."""
    if PLAN is not None:
        files.write_text(Path(PLAN), planning.dump(all_jobs()))
    return refusals(overwritten(planned_by_study()))


def overwritten(planned):
    """Return the finished results that the planned jobs of each study overwrite."""
    return {name: changes.find_overwritten(study_named(name), jobs) for name, jobs in planned.items()}


def refusals(overwritten):
    """Return why this run must not start, or an empty text: it would overwrite finished results, or mix settings."""
    if text := unrecorded():
        return text
    cores = snakemake_internals.cores(workflow)
    texts = [
        changes.refusal(results, name, durations_in(name), cores, bool(study_named(name).ranking.titles))
        for name, results in overwritten.items()
    ]
    return "" if OVERWRITE else "\n\n".join(filter(None, texts))


def check_studies(planned):
    """Check the inputs of the planned jobs, and compile the tracer before any job starts; an error ends the run."""
    needed = {}  # rules by study; all points of a sweep count as one study
    for name, jobs in planned.items():
        study = STUDY if name in (point.name for point in POINTS) else study_named(name.partition("/")[0])
        needed.setdefault(study.name, set()).update(job.rule for job in jobs.values())
    try:
        for name, names_of_rules in needed.items():
            study, networks = study_named(name), bool(names_of_rules & {"reference", "task_reference"})
            if "images" in names_of_rules:
                class_folders.check(study.images)
            if networks or study.imported or "design" in names_of_rules:
                check_in_own_process(study, ["--build-networks"] if networks else [])
    except InputError as error:
        sys.exit(f"{error}")


def check_in_own_process(study, options):
    """Check a study in a process that imports torch and prints the reason; a failed check ends the run."""
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        file.write(loading.dump(study))
        file.flush()
        command = [sys.executable, "-m", "tasklens.cli", "study", "check", file.name, "--no-weight-files", *options]
        if status := subprocess.run(command, stdout=subprocess.DEVNULL).returncode:
            sys.exit(status)


if snakemake_internals.is_main(workflow):
    if snakemake_internals.is_dry_run(workflow):
        snakemake_internals.after_dry_run(words_of_dry_run)
    else:  # these imports are slow, and jobs on a cluster do not need them
        from tasklens.study.run import closing
        from tasklens.study.run.terminal import Terminal

        terminal = Terminal(STUDY, study_named, snakemake_internals.is_quiet(workflow), unrecorded)


onstart:
    snakemake_internals.terminate_safely()
    snakemake_internals.limit_no_rate(workflow)
    planned, cores = planned_by_study(), snakemake_internals.cores(workflow)
    results = overwritten(planned)
    if not snakemake_internals.is_touch(workflow):
        if reason := refusals(results):
            sys.exit(reason)
        check_studies(planned)
    for name, jobs in planned.items():
        if results[name].otherwise:
            amount = changes.amount(results[name].otherwise, durations_in(name), cores)
            print(f"Changed input files, or requested: {amount}")
        if name != whole_study_name(name):
            continue  # pages of parts take only seconds
        print(durations_in(name).forecast([job.rule for job in jobs.values()], cores))
        files.write_text(Path("results", name, "study.yaml"), loading.dump(study_named(name)))  # for readers
    terminal.begin(planned, cores)


onsuccess:
    terminal.end()
    print(closing.success(STUDY, terminal.runs))


onerror:
    terminal.end()
    print(closing.failure(terminal.runs))
