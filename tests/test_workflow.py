"""The study as a workflow: what a dry run plans, and what stops a study before its first job."""

import math
import multiprocessing
import os
import re
import subprocess
import sys
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
import yaml
from examples import changed, make_lens, studies_we_ship, tiny_study
from rules import workflow

from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import Prescription
from tasklens.study.loading import at_points, load, parse, read
from tasklens.study.parts import parts
from tasklens.study.study import Study

ROOT = Path(__file__).parents[1]
STUDIES = studies_we_ship()
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


PAGE_JOBS = ("psf_tail_table", "effort_table", "captures", "report_page")


def by_network(lens) -> list:
    """The descents of a lens on the loss of a network."""
    return [descent for descent in getattr(lens.design, "descents", ()) if descent.criterion == "task"]


def task_driven(lens) -> bool:
    """True if the network is frozen at first, or trained with a lens that is chosen from a list."""
    descents = by_network(lens)
    return bool(descents) and (descents[0].network_learning_rate is None or isinstance(lens.design.start, tuple))


class Expected:
    """Jobs counted from a study, by what the paper's tables are about."""

    def __init__(self, study: Study):
        self.study = study
        self.shown: set[str] = set()  # lenses in the tables of the study
        self.measured: set[tuple[str, str, bool]] = set()  # lens, classifier, restored or not
        self.waiting: set[str] = set()  # further lenses that are designed: those to start from
        for table in study.tables:
            lenses = [lens for lens in study.lenses.values() if self._is_in(table, lens)]
            classifiers = study.classifiers if table == "table2" else [study.supervisor]
            self.shown |= {lens.name for lens in lenses}
            self.measured |= {("sharp", classifier, False) for classifier in classifiers}
            self.measured |= {(lens.name, c, table == "table4") for lens in lenses for c in classifiers}
            self.add_starts(lenses)

    def _is_in(self, table: str, lens) -> bool:
        if getattr(lens.design, "task", None):  # shown in the table of its task
            return False
        if table == "table4" and self.study.restored is not None and lens.elements not in self.study.restored:
            return False
        return bool(by_network(lens)) if table == "table3" else task_driven(lens) or not by_network(lens)

    def add_starts(self, lenses) -> None:
        for lens in lenses:
            start, named = getattr(lens.design, "start", None), ()
            if start == "best_imaging":
                named = self.study.imaging_starts
            elif isinstance(start, tuple) and lens.design.descents[-1].network_learning_rate:
                named = start
            if named:
                starts = {f"{lens.elements}-{name}" for name in named}
                self.waiting |= starts
                self.measured |= {(name, self.study.supervisor, False) for name in starts}

    @property
    def designed(self) -> set[str]:
        return self.shown | self.waiting

    def counts(self, *seedless: tuple[str, int], **others: int) -> dict[str, int]:
        """Jobs of these lenses and measurements; the numbers of `others` are per seed."""
        supervised = [self.study.lens(name) for name in self.designed]
        needed = {classifier for _, classifier, _ in self.measured}
        if any(map(by_network, supervised)):
            needed |= {self.study.supervisor}
        by_seed = {
            "design": len(self.designed),
            "diffraction": len(self.designed) if self.study.capture.diffraction else 0,
            "fine_tune": len(self.measured),
            "restore": len({lens for lens, _, restored in self.measured if restored}),
            **others,
        }
        counts = {name: count * len(self.study.seeds) for name, count in by_seed.items()}
        early = len(parts(self.study))
        counts |= {"images": 1, "reference": len(needed), "table": len(self.study.tables) + early, **dict(seedless)}
        counts |= dict.fromkeys(("verdicts_table", *PAGE_JOBS), 1 + early)
        return {name: count for name, count in counts.items() if count}


def expected(study: Study) -> dict[str, int]:
    """Jobs of the target `tables`."""
    jobs = Expected(study)
    return jobs.counts(("certificate", len(jobs.shown)))  # of the first seed, for the report


def expected_of_everything(study: Study) -> dict[str, int]:
    """Jobs of all tables, figures, certificates and ablations, and of the verification of the tables."""
    jobs = Expected(study)
    again = len(jobs.measured - {(name, study.supervisor, False) for name in jobs.waiting - jobs.shown})
    drawn = {lens.elements for lens in study.lenses.values() if task_driven(lens)}
    jobs.measured |= {  # the best imaging lens stands beside the task-driven one
        (f"{elements}-{name}", study.supervisor, False) for elements in drawn for name in study.imaging_designs
    }
    jobs.waiting |= set(study.lenses)
    for name, item in study.ablations.items():
        designs = [item.design, *(item.name(name, variant) for variant in item.variants)]
        lenses = [f"{item.elements}-{design}" for design in designs]
        jobs.waiting |= set(lenses)
        jobs.measured |= {(lens, study.supervisor, False) for lens in lenses}
        jobs.add_starts([study.lens(lens) for lens in lenses])
    every = len(study.lenses)
    per_seed = {
        "certificate": every,
        "drawing": every,
        "comparison": len(drawn),
        "frames": len(drawn),
        "reproduce": again,
    }
    return jobs.counts(("ablation", len(study.ablations)), **per_seed)


@pytest.fixture
def beside_config(tmp_path):
    """A folder from which the studies that we ship are in `config/`."""
    (tmp_path / "config").symlink_to(ROOT / "config")
    return tmp_path


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_plans_its_jobs(beside_config, name):
    """A dry run counts what the study implies: for its tables, and for all that can be asked for of a file alone."""
    paths = [STUDIES[name]]
    study = load(*paths)
    for weights in filter(None, (classifier.weights for classifier in study.classifiers.values())):
        (beside_config / weights).parent.mkdir(parents=True, exist_ok=True)
        (beside_config / weights).touch()  # a user's own file
    if study.sweep:
        jobs = sum((Counter(expected(point)) for point in at_points(study)), Counter())
        assert plan(beside_config, paths, "tables") == jobs | {"sweep_table": 1}
        return
    assert plan(beside_config, paths, "tables") == expected(study)
    if "extends" in read(STUDIES[name]):  # a study that is planned here
        return
    targets = ["tables", "verify", "figures", "certificates", "figure3", "figure4"]
    targets += ["ablations"] if study.ablations else []
    assert plan(beside_config, paths, *targets) == expected_of_everything(study)


def test_single_values_change_the_default_study(beside_config):
    """Without a study file `--config` is laid over config/config.yaml: two seeds instead of one."""
    study = load(ROOT / "config" / "config.yaml").model_copy(update={"seeds": (3, 4)})
    assert plan(beside_config, None, "tables", "--config", "seeds=[3, 4]") == expected(study)


@pytest.mark.parametrize("options, gpus", [((), "gpu=1"), (("--config", "gpus=false"), "gpu=0")])
def test_a_cluster_without_gpus_is_asked_for_none(tmp_path, options, gpus):
    status, output = forked(tmp_path, tiny_study(), "--dry-run", "table1", *options)
    asked = re.findall(r"rule reference:(?:.|\n)*?(gpu=\d)", output)
    assert status == 0 and set(asked) == {gpus}


def test_a_flag_is_true_or_false(tmp_path):
    status, output = forked(tmp_path, tiny_study(), "--dry-run", "table1", "--config", "overwrite=maybe")
    assert status != 0 and "overwrite=maybe: expected true or false" in output


@pytest.mark.parametrize("target", ["tables", "verify"])
def test_table_1_alone_takes_the_lenses_of_table_1_alone(beside_config, target):
    """18 lenses of the default study, not all 24: nothing else waits for those of end-to-end design."""
    one = {"images": 1, "reference": 1, "table": 1, "verdicts_table": 1, "design": 18, "fine_tune": 19}
    others = {"reproduce": 19}
    if target == "tables":  # a page of the doublets, one of doublets and triplets, and the whole one
        one |= {"table": 3, "verdicts_table": 3}
        others = {"certificate": 18} | dict.fromkeys(PAGE_JOBS, 3)
    assert plan(beside_config, None, target, "--config", 'tables=["table1"]') == one | others


def test_a_study_file_without_a_format_is_refused(beside_config):
    study = tiny_study()
    del study["format"]
    status, output = forked(beside_config, study, "--dry-run", "table1")
    assert status != 0 and "format" in output


@pytest.mark.parametrize(
    "key, value, words",
    [
        ("spec.kernle", 51, ["spec.kernle", "51"]),
        ("spec.kernel", 51, ["spec.kernel = 51", "an older format; it is now kernel_size"]),
        ("elements.doublet", ["GLASS"], ["GLASS", "doublet"]),
        ("imported.phone", {"elements": "quadruplet", "file": "no/phone.zmx"}, ["imported.phone.file", "no/phone.zmx"]),
    ],
)
def test_a_mistake_in_the_study_stops_before_any_job(tmp_path, key, value, words):
    status, message = forked(tmp_path, changed(tiny_study(), key, value), "table1")
    assert status != 0
    assert all(word in message for word in words) and "Traceback" not in message
    assert not (tmp_path / "results").exists()


def test_task_driven_designs_wait_for_what_they_need(tmp_path):
    """A spot design needs nothing; TaskLens its supervisor; end-to-end from imaging also the baselines' accuracies."""
    lens = "results/tiny/lenses/singlet-{}/seed0/lens.yaml"
    assert plan(tmp_path, tiny_study(), lens.format("imaging1")) == {"design": 1}
    supervised = {"images": 1, "reference": 1, "design": 1}
    assert plan(tmp_path, tiny_study(), lens.format("tasklens")) == supervised
    baselines = {"images": 1, "reference": 1, "design": 4, "fine_tune": 3}
    assert plan(tmp_path, tiny_study(), lens.format("end_to_end_from_imaging")) == baselines


# ---- an imported lens


def with_imported(folder: Path) -> dict:
    """The smoke study and a singlet of somebody else in `folder`, of a glass in a catalogue of its own."""
    (folder / "glass.agf").write_text("NM COC 1 0 1.5 50\nCD 2.3 0 0.01 0 0 0\nLD 0.4 0.8\n")
    lens = make_lens([0.0, 1.0, 0.0], [0.1, 0.5, 1.5], ("air", "COC", "air"), semi_diameter=[0.3, math.inf, math.inf])
    use = {"fields": ("angle_deg", ((0.0, 0.0),)), "wavelengths_um": (0.5893,), "primary": 0}
    zemax.write(folder / "singlet.zmx", Prescription(lens, **use))
    entry = {"elements": "singlet", "file": "singlet.zmx", "catalogues": ["glass.agf"]}
    return changed(yaml.safe_load((ROOT / "config" / "smoke.yaml").read_text()), "imported.theirs", entry)


def test_an_imported_lens_joins_the_tables(tmp_path, monkeypatch):
    """It has the jobs of an imaging design, and no other lens waits for it."""
    study = with_imported(tmp_path)
    monkeypatch.chdir(tmp_path)
    counts = expected(parse(study))
    assert counts["design"] == 6 and counts["restore"] == 4
    assert plan(tmp_path, study, "tables") == counts
    lens = "results/smoke/lenses/{}/seed0/lens.yaml"
    assert plan(tmp_path, study, lens.format("singlet-theirs")) == {"design": 1}
    assert plan(tmp_path, study, lens.format("doublet-end_to_end_from_imaging"))["design"] == 3
