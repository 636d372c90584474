"""Runs and dry runs of Snakemake on a study, as a person starts them or in a copy of this process."""

import math
import multiprocessing
import os
import re
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import yaml
from examples import make_lens
from rules import ROOT, workflow
from studies import changed

from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import Prescription

FORK = multiprocessing.get_context("fork")


def arguments(folder: Path, study: dict | list[Path] | None, *others: str) -> list[str]:
    """Of Snakemake on a study, or its files, with everything it writes below `folder`."""
    if isinstance(study, dict):
        path = folder / "study.yaml"
        path.write_text(yaml.safe_dump(study))
        study = [path]
    where = ["--snakefile", str(ROOT / "Snakefile"), "--directory", str(folder), "--cores", "1"]
    return [*where, *others, *(["--configfile", *map(str, study)] if study else [])]


def command(folder: Path, study: dict | list[Path] | None, *others: str) -> list[str]:
    """A run of Snakemake as a person starts it."""
    return [sys.executable, "-m", "snakemake", *arguments(folder, study, *others)]


def snakemake(folder: Path, study: dict | list[Path] | None, *others: str) -> subprocess.CompletedProcess:
    return subprocess.run(command(folder, study, *others), capture_output=True, text=True, cwd=folder)


def forked(folder: Path, study: dict | list[Path] | None, *others: str) -> tuple[int, str]:
    """Exit status and output of Snakemake in a copy of this process, which has imported everything already.

    Half of the time of a process of its own, where no job runs.
    """
    import snakemake.cli

    workflow()  # its digests of code are cached for every copy
    output = folder / "output.txt"

    def run() -> None:
        os.chdir(folder)
        with output.open("w") as file, redirect_stdout(file), redirect_stderr(file):
            snakemake.cli.main(arguments(folder, study, *others))

    process = FORK.Process(target=run)
    process.start()
    process.join()
    return process.exitcode, output.read_text()


def plan(folder: Path, study: dict | list[Path] | None, *targets: str) -> dict[str, int]:
    """Number of jobs by rule that a dry run plans; targets themselves are left out."""
    status, output = forked(folder, study, "--dry-run", *targets)
    assert status == 0, output
    if "Nothing to be done" in output:
        return {}
    table = re.search(r"^job +count\n-+ +-+\n(.*?)^total +(\d+)$", output, re.DOTALL | re.MULTILINE)
    counts = {name: int(count) for name, count in (line.split() for line in table[1].splitlines())}
    assert sum(counts.values()) == int(table[2])
    return {name: count for name, count in counts.items() if name not in targets}


def smoke_with_imported(folder: Path) -> dict:
    """The smoke study and a singlet of somebody else in `folder`, of a glass in a catalogue of its own."""
    (folder / "glass.agf").write_text("NM COC 1 0 1.5 50\nCD 2.3 0 0.01 0 0 0\nLD 0.4 0.8\n")
    lens = make_lens([0.0, 1.0, 0.0], [0.1, 0.5, 1.5], ("air", "COC", "air"), semi_diameter=[0.3, math.inf, math.inf])
    use = {"fields": ("angle_deg", ((0.0, 0.0),)), "wavelengths_um": (0.5893,), "primary": 0}
    zemax.write(folder / "singlet.zmx", Prescription(lens, **use))
    entry = {"elements": "singlet", "file": "singlet.zmx", "catalogues": ["glass.agf"]}
    return changed(yaml.safe_load((ROOT / "config" / "smoke.yaml").read_text()), "imported.theirs", entry)
