"""Run a small study on SLURM while jobs are cancelled and go over their limits, and nodes are drained and go down.

    tests/cluster/slurm.sh up; python tests/harness/cluster.py; tests/cluster/slurm.sh down

Exit status 1, and the folder is kept, if a result differs from that of `-j2` on this machine. Needs a cluster of one
node, on which SLURM runs nothing else.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import yaml
from small_study import TARGETS, changed, contents, copy_code, differences, small_study

SLURM = ["--workflow-profile", "profiles/slurm", "--config", "gpus=false", "--slurm-status-command", "squeue"]
SLURM += ["--slurm-init-seconds-before-status-checks", "1", "--seconds-between-status-checks", "1"]
# The first attempt of a restoration has too little memory, the next one enough.
SLURM += ["--latency-wait", "5", "--max-threads", "2", "--set-resources"]
SLURM += ["restore:mem_mb=300 if attempt == 1 else 4000"]


def scontrol(*words: str) -> None:
    subprocess.run(["scontrol", "update", *words], check=True)


def node(state: str, seconds: float) -> None:
    """Put the node into a state for a while."""
    name = subprocess.run(["sinfo", "-h", "-o", "%n"], check=True, capture_output=True, text=True).stdout.split()[0]
    scontrol(f"NodeName={name}", f"State={state}", "Reason=test")
    time.sleep(seconds)
    subprocess.run(["scontrol", "update", f"NodeName={name}", "State=RESUME"])  # one that was down may be up by itself


def down(job: str) -> bool:
    """Let the node go down under a job; whether SLURM put it into its queue again, and it had not just ended."""
    node("DOWN", 5)
    output = subprocess.run(["scontrol", "show", "job", job], check=True, capture_output=True, text=True).stdout
    return "Restarts=0" not in output


FAULTS: dict[str, tuple[str, Callable[[str], object]]] = {  # by what is done, the job that must run, and how
    "cancelled": ("reference", lambda job: subprocess.run(["scancel", job], check=True)),
    "over its time": ("design_wildcards_tiny_singlet-imaging1", lambda job: scontrol(f"JobId={job}", "TimeLimit=0:01")),
    "drained": ("design", lambda job: node("DRAIN", 10)),
    "down": ("fine_tune", down),
}
# Cancelled, and over their memory. SLURM looks at limits of time every half minute: a job may have ended by then.
FAILING = ("reference small", "restore")


def running() -> dict[str, str]:
    """Jobs that run, by rule and wildcards."""
    output = subprocess.run(
        ["squeue", "-h", "-t", "R", "-o", "%i|%k"], check=True, capture_output=True, text=True
    ).stdout
    return {comment.removeprefix("rule_"): job for job, _, comment in (line.partition("|") for line in output.split())}


def run(folder: Path, code: Path, faults: list[str], *arguments: str) -> int:
    """Run Snakemake in a folder, with faults when their jobs run; returns its exit status."""
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(code / "Snakefile"), "--directory", str(folder)]
    command += [*TARGETS, "--configfile", "study.yaml", *arguments]
    variables = os.environ | {"PYTHONPATH": str(code), "NUMBA_CACHE_DIR": str(code / "compiled")}
    with (folder / "output.txt").open("a") as out:
        process = subprocess.Popen(command, cwd=folder, env=variables, stdout=out, stderr=out)
    while process.poll() is None:
        time.sleep(1)
        for what, name in [(what, name) for what in faults for name in running() if name.startswith(FAULTS[what][0])]:
            time.sleep(4)  # so that it is at work
            job = running().get(name)
            if what in faults and job is not None and FAULTS[what][1](job) is not False:
                print(f"{what}: {name}", flush=True)
                faults.remove(what)
    return process.returncode


def main() -> int:
    parent = Path(tempfile.mkdtemp(prefix="cluster-"))
    code, faults = parent / "code", list(FAULTS)
    copy_code(code)
    study = changed(small_study(), "designs.imaging1.descents.0.steps", 16000)  # a minute and a half
    for name in ("here", "slurm"):
        (parent / name).mkdir()
        (parent / name / "study.yaml").write_text(yaml.safe_dump(study))
    shutil.copytree(code / "profiles", parent / "slurm/profiles")
    assert run(parent / "here", code, [], "-j2") == 0, parent
    for attempt in range(1, 6):  # a job without a second attempt ends the run, and people start it again
        status = run(parent / "slurm", code, faults, *SLURM)
        print(f"run {attempt} on SLURM: exit status {status}", flush=True)
        if status == 0 and not faults:
            break
    failed = [line.strip() for line in (parent / "slurm/output.txt").read_text().splitlines() if "FAILED" in line]
    print(*failed, sep="\n")
    unhurt = [name for name in FAILING if name not in " ".join(failed)]
    # Without cgroups, a job that SLURM has killed can leave its Snakemake behind.
    subprocess.run(["pkill", "-KILL", "-f", str(code / "Snakefile")], check=False)
    different = differences(contents(parent / "slurm"), contents(parent / "here"))
    print(
        ", ".join(different) if different else "equal",
        *(f"{name}: nothing happened to it" for name in unhurt),
        sep="\n",
    )
    if status or faults or different or unhurt:
        return 1
    shutil.rmtree(parent)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
