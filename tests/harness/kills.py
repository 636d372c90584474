"""Kill whole runs of a small study at random, go on as the documentation says, and compare all results to the byte.

    python tests/harness/kills.py --kills 30 --seed 0

On two cores half a minute a kill, and two minutes before the first. The study makes its tables by every kind of job
that they need, with a copy of the code that writes checkpoints every half second in place of every minute, so that most
kills meet one. Exit status 1, and the folder is kept, if a result differs, or a checkpoint or temporary file is left.
"""

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import psutil
import yaml
from small_study import TARGETS, contents, copy_code, differences, small_study

KINDS = ["group killed", "Snakemake killed", "job killed", "Snakemake terminated", "interrupted twice"]
SESSIONS: set[int] = set()  # of all processes that were started here


def processes() -> list[psutil.Process]:
    """All that were started here and live, with their children, also those whose parent was killed."""
    living = []
    for process in psutil.process_iter():
        with suppress(psutil.NoSuchProcess, OSError):  # it has just ended
            if os.getsid(process.pid) in SESSIONS and process.status() != psutil.STATUS_ZOMBIE:
                living.append(process)
    return living


def jobs() -> dict[int, str]:
    """The jobs that run, by process."""
    running = {}
    for process in processes():
        with suppress(psutil.NoSuchProcess, OSError):
            words = process.cmdline()
            if len(words) == 2 and words[1].endswith(".job.py"):  # its standard error is its log
                log = os.readlink(f"/proc/{process.pid}/fd/2")
                running[process.pid] = log.partition("/logs/")[2].removesuffix(".log") or "a job that starts"
    return running


def start(folder: Path, *arguments: str) -> psutil.Popen:
    """Start Snakemake on the study in a folder, in a session of its own."""
    code = folder.parent / "code"
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(code / "Snakefile"), "--directory", str(folder)]
    command += ["-j2", *(arguments or TARGETS), "--configfile", "study.yaml"]
    variables = os.environ | {"PYTHONPATH": str(code), "NUMBA_CACHE_DIR": str(code / "compiled")}
    with (folder / "output.txt").open("a") as out:
        run = psutil.Popen(command, cwd=folder, env=variables, stdout=out, stderr=out, start_new_session=True)
    SESSIONS.add(run.pid)
    return run


def ends(run: psutil.Popen, seconds: float) -> bool:
    """Return whether a run ends within so many seconds."""
    return bool(psutil.wait_procs([run], seconds)[0])


def kill(run: psutil.Popen, kind: str, chance: random.Random) -> None:
    """Kill what the kind says; while no job runs, Snakemake in place of it."""
    if kind == "group killed":
        os.killpg(run.pid, signal.SIGKILL)
    elif kind == "job killed" and (running := sorted(jobs())):
        with suppress(ProcessLookupError):  # it has ended by itself
            os.kill(chance.choice(running), signal.SIGKILL)
    elif kind == "interrupted twice":  # as by Ctrl-C in a terminal
        os.killpg(run.pid, signal.SIGINT)
        if not ends(run, 0.5):
            os.killpg(run.pid, signal.SIGINT)
    else:
        os.kill(run.pid, signal.SIGTERM if kind == "Snakemake terminated" else signal.SIGKILL)


def run_to_the_end(folder: Path, kinds: list[str], length: float, chance: random.Random) -> int:
    """Run the study in a new folder, with a kill of each kind until it is complete; returns how many there were."""
    folder.mkdir()
    (folder / "study.yaml").write_text(yaml.safe_dump(small_study()))
    count = failures = 0
    while failures < 2:
        if any((folder / ".snakemake/locks").glob("*")):
            assert ends(start(folder, "--unlock"), 120)
        run, began, before = start(folder), time.monotonic(), count
        while count < len(kinds) and not ends(run, chance.uniform(0, length / 4)):
            running = ", ".join(jobs().values()) or "no job"
            print(f"{folder.name}  {time.monotonic() - began:5.1f} s  {kinds[count]}: {running}", flush=True)
            kill(run, kinds[count], chance)
            count += 1
            if kinds[count - 1] != "job killed":  # which Snakemake starts again
                assert ends(run, 120), f"{folder}: Snakemake goes on"
        assert ends(run, 20 * length), f"{folder}: Snakemake does not end"
        if run.returncode == 0 and (count == before or kinds[count - 1] == "job killed"):
            return count
        failures = failures + 1 if count == before else 0
        if failures:  # a job of an earlier run writes the same file, perhaps
            print(f"{folder.name}  failed without a kill", flush=True)
            psutil.wait_procs(processes(), 120)
    raise SystemExit(f"{folder}: fails; see output.txt")


def compare(parent: Path, kills: int, chance: random.Random) -> bool:
    """Run the study uninterrupted, then again and again until there were so many kills; whether all are equal."""
    copy_code(parent / "code")
    began = time.monotonic()
    run_to_the_end(parent / "uninterrupted", [], 100, chance)
    length, expected = time.monotonic() - began, contents(parent / "uninterrupted")
    print(f"uninterrupted: {length:.0f} s, {len(expected)} files to compare, in {parent}", flush=True)
    done = studies = unequal = 0
    while done < kills:
        studies += 1
        folder, kinds = parent / f"study{studies}", [KINDS[k % len(KINDS)] for k in range(done, kills)]
        count = run_to_the_end(folder, kinds, length, chance)
        done += count
        psutil.wait_procs(processes(), 120)  # jobs that outlive their Snakemake
        different = ", ".join(differences(contents(folder), expected))
        unequal += bool(different)
        print(f"{folder.name}  complete after {count} kills: {different or 'equal'}", flush=True)
    minutes = (time.monotonic() - began) / 60
    print(f"{done} kills, {studies} studies, {minutes:.0f} minutes: {f'{unequal} differ' if unequal else 'all equal'}")
    return unequal == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=30, help="how many (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments and jobs (default: %(default)s)")
    options, parent = parser.parse_args(), Path(tempfile.mkdtemp(prefix="kills-"))
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell ignores in the background
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        equal = compare(parent, options.kills, random.Random(options.seed))
    finally:
        for process in processes():
            with suppress(psutil.NoSuchProcess):
                process.kill()
    if equal:
        shutil.rmtree(parent)
    return int(not equal)


if __name__ == "__main__":
    raise SystemExit(main())
