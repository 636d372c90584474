"""The study as a workflow: plans of all studies, one true small run, and what reruns after a change."""

import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from examples import changed, make_lens, tiny_study

from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import Prescription
from tasklens.pipeline import jobs
from tasklens.study.design_settings import EndToEndSettings
from tasklens.study.study import Study, load, parse

ROOT = Path(__file__).parents[1]
CONFIGS = sorted((ROOT / "config").glob("*.yaml"))
CONFIGS = [path for path in CONFIGS if "format: 1" in path.read_text()]  # the others are laid over the default study


def command(folder: Path, study: dict | Path | None, *arguments: str) -> list[str]:
    """Snakemake on a study, with everything it writes below `folder`."""
    call = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile"), "--directory", str(folder)]
    if isinstance(study, dict):
        path = folder / "study.yaml"
        path.write_text(yaml.safe_dump(study))
        study = path
    return [*call, "--cores", "1", *arguments, *(["--configfile", str(study)] if study else [])]


def snakemake(folder: Path, study: dict | Path | None, *arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(command(folder, study, *arguments), capture_output=True, text=True, cwd=folder)


def plan(folder: Path, study: dict | Path | None, *targets: str) -> dict[str, int]:
    """Number of jobs by rule that a dry run plans; targets themselves are left out."""
    done = snakemake(folder, study, "--dry-run", *targets)
    output = done.stdout + done.stderr
    assert done.returncode == 0, output
    if "Nothing to be done" in output:
        return {}
    table = re.search(r"^job +count\n-+ +-+\n(.*?)^total +(\d+)$", output, re.DOTALL | re.MULTILINE)
    counts = {name: int(count) for name, count in (line.split() for line in table[1].splitlines())}
    assert sum(counts.values()) == int(table[2])
    return {name: count for name, count in counts.items() if name not in targets}


def expected(study: Study) -> dict[str, int]:
    """Jobs of all tables, counted from the study."""
    seeds, all_lenses = len(study.seeds), len(study.lenses)
    end_to_end = sum(isinstance(lens.design, EndToEndSettings) for lens in study.lenses.values())
    compared = all_lenses - end_to_end  # in tables 1, 2 and 4; the end-to-end lenses stand in table 3 only
    restored = len(jobs.table(study, "table4").lenses) if "table4" in study.tables else 0
    classifiers = len(study.classifiers) if "table2" in study.tables else 1
    counts = {
        "images": 1,
        "reference": classifiers,
        "design": all_lenses * seeds,
        "psf": all_lenses * seeds,
        "fine_tune": ((1 + compared) * classifiers + end_to_end) * seeds,
        "restore": restored * seeds,
        "fine_tune_restored": restored * seeds,
        "table": len(study.tables),
        "tail": all_lenses * seeds,
        "psf_tail": 1,
        "verdicts": 1,
    }
    return {name: count for name, count in counts.items() if count}


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.name)
def test_every_study_plans_its_jobs(tmp_path, path):
    """A dry run counts what the study implies."""
    study = load(path)
    for weights in filter(None, (classifier.weights for classifier in study.classifiers.values())):
        (tmp_path / weights).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / weights).touch()  # a user's own file
    assert plan(tmp_path, path, "tables") == expected(study)
    verified = plan(tmp_path, path, "verify")
    assert verified["reproduce"] == verified["fine_tune"]
    assert verified.get("reproduce_restored") == verified.get("fine_tune_restored")
    every = len(study.lenses) * len(study.seeds)
    assert plan(tmp_path, path, "figures")["figure"] == every
    assert plan(tmp_path, path, "certificates")["certificate"] == every
    assert plan(tmp_path, path, "figure3")["comparison"] == len(study.elements) * len(study.seeds)
    if study.ablations:
        compared = plan(tmp_path, path, "ablations")
        bases = {(a.elements, a.design) for a in study.ablations.values()}
        assert compared["ablation"] == len(study.ablations)
        assert compared["psf"] == (len(study.variants) + len(bases)) * len(study.seeds)


def test_single_values_change_the_default_study(tmp_path):
    """Without a study file `--config` is laid over config/config.yaml: two seeds instead of one."""
    (tmp_path / "config").symlink_to(ROOT / "config")
    study = load(ROOT / "config" / "config.yaml").model_copy(update={"seeds": (3, 4)})
    assert plan(tmp_path, None, "tables", "--config", "seeds=[3, 4]") == expected(study)


def test_the_headline_makes_tables_1_and_3_for_five_seeds(tmp_path):
    """Laid over the default study; no other network, no restoration."""
    (tmp_path / "config").symlink_to(ROOT / "config")
    study = load(ROOT / "config" / "config.yaml")
    planned = plan(tmp_path, None, "tables", "--configfile", "config/config.yaml", "config/headline.yaml")
    assert planned.pop("fine_tune") == 5 * (1 + len(study.lenses)) and planned.pop("table") == 2
    one = {"images": 1, "reference": 1, "psf_tail": 1, "verdicts": 1}
    assert planned == one | dict.fromkeys(("design", "psf", "tail"), 5 * len(study.lenses))


def test_a_study_file_without_a_format_is_refused(tmp_path):
    (tmp_path / "config").symlink_to(ROOT / "config")
    study = tiny_study()
    del study["format"]
    done = snakemake(tmp_path, study, "--dry-run", "table1")
    assert done.returncode != 0 and "format" in done.stdout + done.stderr


@pytest.mark.parametrize(
    "key, value, words",
    [
        ("spec.kernle", 51, ["spec.kernle", "51"]),
        ("elements.doublet", ["GLASS"], ["GLASS", "doublet"]),
        ("imported.phone", {"elements": "quadruplet", "file": "no/phone.zmx"}, ["imported.phone.file", "no/phone.zmx"]),
    ],
)
def test_a_mistake_in_the_study_stops_before_any_job(tmp_path, key, value, words):
    done = snakemake(tmp_path, changed(tiny_study(), key, value), "table1")
    assert done.returncode != 0
    message = done.stdout + done.stderr
    assert all(word in message for word in words) and "Traceback" not in message
    assert not (tmp_path / "results").exists()


def test_task_driven_designs_wait_for_what_they_need(tmp_path):
    """A spot design needs nothing; TaskLens its supervisor; end-to-end from imaging also the baselines' accuracies."""
    lens = "results/tiny/lenses/singlet-{}/seed0/lens.yaml"
    assert plan(tmp_path, tiny_study(), lens.format("imaging1")) == {"design": 1}
    supervised = {"images": 1, "reference": 1, "design": 1}
    assert plan(tmp_path, tiny_study(), lens.format("tasklens")) == supervised
    baselines = {"images": 1, "reference": 1, "design": 3, "psf": 2, "fine_tune": 2}
    assert plan(tmp_path, tiny_study(), lens.format("end_to_end_from_imaging")) == baselines


# ---- a lens from outside


def with_outside(folder: Path) -> dict:
    """The smoke study and a singlet of somebody else in `folder`, of a glass in a catalogue of its own."""
    (folder / "glass.agf").write_text("NM COC 1 0 1.5 50\nCD 2.3 0 0.01 0 0 0\nLD 0.4 0.8\n")
    lens = make_lens([0.0, 1.0, 0.0], [0.1, 0.5, 1.5], ("air", "COC", "air"), semi_diameter=[0.3, math.inf, math.inf])
    use = {"fields": ("angle_deg", ((0.0, 0.0),)), "wavelengths_um": (0.5893,), "primary": 0}
    zemax.write(folder / "singlet.zmx", Prescription(lens, **use))
    entry = {"elements": "singlet", "file": "singlet.zmx", "catalogues": ["glass.agf"]}
    return changed(yaml.safe_load((ROOT / "config" / "smoke.yaml").read_text()), "imported.theirs", entry)


def test_a_lens_from_outside_joins_the_tables(tmp_path, monkeypatch):
    """It has the jobs of an imaging design, and no other lens waits for it."""
    study = with_outside(tmp_path)
    monkeypatch.chdir(tmp_path)
    jobs = expected(parse(study))
    assert jobs["design"] == 7 and jobs["restore"] == 5
    assert plan(tmp_path, study, "tables") == jobs
    lens = "results/smoke/lenses/{}/seed0/lens.yaml"
    assert plan(tmp_path, study, lens.format("singlet-theirs")) == {"design": 1}
    assert plan(tmp_path, study, lens.format("doublet-end_to_end_from_imaging"))["design"] == 4


def test_a_changed_file_reruns_the_lens_from_outside(tmp_path):
    """The lens file or a catalogue; a file that cannot be used stops the study before its first job."""
    study, target = with_outside(tmp_path), "results/smoke/lenses/singlet-theirs/seed0/lens.yaml"
    done = snakemake(tmp_path, study, target)
    assert done.returncode == 0 and (tmp_path / target).exists(), done.stdout + done.stderr
    assert plan(tmp_path, study, target) == {}
    for name, old, new in (("singlet.zmx", "DISZ 0.5", "DISZ 0.6"), ("glass.agf", "2.3", "2.4")):
        path = tmp_path / name
        before, times = path.read_text(), (path.stat().st_atime, path.stat().st_mtime)
        path.write_text(before.replace(old, new))
        assert path.read_text() != before and plan(tmp_path, study, target) == {"design": 1}
        path.write_text(before)
        os.utime(path, times)
    path.write_text("NM COC 1 0 1.5\n")
    done = snakemake(tmp_path, study, "results/smoke/images/train.safetensors")
    assert done.returncode != 0 and "glass.agf" in done.stdout + done.stderr
    assert not (tmp_path / "results/smoke/images").exists()


# ---- a true run


def one_lens() -> dict:
    study = tiny_study()
    return study | {"designs": {"imaging1": study["designs"]["imaging1"]}}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Table 1 of one lens, truly run."""
    folder = tmp_path_factory.mktemp("run")
    done = snakemake(folder, one_lens(), "table1")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "**Table 1" in done.stdout + done.stderr
    return folder


def test_a_finished_table_has_nothing_to_be_done(finished):
    """The run wrote the study with every default, the table, and is complete."""
    assert load(finished / "results/tiny/study.yaml") == parse(one_lens())
    text = (finished / "results/tiny/tables/table1.csv").read_text().splitlines()
    assert [line.split(",")[:2] for line in text[1:]] == [["", "reference"], ["singlet", "imaging1"]]
    assert plan(finished, one_lens(), "table1") == {}


def test_a_dry_run_changes_nothing(finished):
    """Planning another value must not change the study that a run in progress reads."""
    before = (finished / "results/tiny/study.yaml").read_text()
    plan(finished, changed(one_lens(), "fine_tuning.learning_rate", 4e-3), "table1")
    assert (finished / "results/tiny/study.yaml").read_text() == before


@pytest.mark.parametrize(
    "key, value, jobs",
    [
        ("minutes.design", 9, {}),
        ("restoration.steps", 9, {}),
        ("designs.tasklens", tiny_study()["designs"]["tasklens"], {"design": 1, "psf": 1, "fine_tune": 1, "table": 1}),
        ("fine_tuning.learning_rate", 5e-3, {"fine_tune": 2, "table": 1}),
        ("capture.outside_window", "renormalise", {"fine_tune": 1, "table": 1}),
        ("evaluation_rays", 128, {"design": 1, "psf": 1, "fine_tune": 1, "table": 1}),
        ("constraints.max_track", 4.3, {"design": 1, "psf": 1, "fine_tune": 1, "table": 1}),
        ("classifiers.small.training.learning_rate", 2e-3, {"reference": 1, "fine_tune": 2, "table": 1}),
        ("images.seed", 4, {"images": 1, "reference": 1, "fine_tune": 2, "table": 1}),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_a_changed_value_reruns_what_reads_it(finished, key, value, jobs):
    """And what comes after that, up to the table; everything else stays."""
    found = plan(finished, changed(one_lens(), key, value), "table1")
    assert found == jobs


def test_a_failing_job_leaves_no_output(tmp_path):
    """An unreadable image: the images job fails, names the file in its log, and leaves no split behind."""
    from PIL import Image

    for split, name in (("train", "a"), ("train", "b"), ("val", "a"), ("val", "b")):
        (tmp_path / "photos" / split / name).mkdir(parents=True)
        for k in range(3):
            Image.new("RGB", (16, 16)).save(tmp_path / "photos" / split / name / f"{k}.png")
    bad = tmp_path / "photos" / "val" / "b" / "1.png"
    bad.write_text("not an image")
    images = {"size": 16, "minival": 2, "folder": str(tmp_path / "photos")}
    done = snakemake(tmp_path, changed(one_lens(), "images", images), "results/tiny/images/train.safetensors")
    assert done.returncode != 0
    assert str(bad) in (tmp_path / "results/tiny/logs/images.log").read_text()
    assert not list((tmp_path / "results/tiny").rglob("*.safetensors"))


def test_a_killed_run_goes_on(tmp_path):
    """Killed with Snakemake in the midst of a long design: neither lens nor history; unlocked, it is made again.

    Also where one of its two files is there already.
    """
    study = changed(one_lens(), "designs.imaging1.steps", 1_000_000)
    target, log = "results/tiny/lenses/singlet-imaging1/seed0/lens.yaml", tmp_path / "results/tiny/logs/design"
    process = subprocess.Popen(
        command(tmp_path, study, target),
        cwd=tmp_path,
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline = time.monotonic() + 60
        while not any("step 1/" in path.read_text() for path in log.glob("*.log")):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.2)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    assert not [path for path in (tmp_path / "results/tiny/lenses").rglob("*") if path.is_file()]
    assert plan(tmp_path, study, target) == {"design": 1}
    (tmp_path / target).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / target).write_text("half")
    study = one_lens()
    assert snakemake(tmp_path, study, "--unlock").returncode == 0
    done = snakemake(tmp_path, study, target)
    assert done.returncode == 0, done.stderr
    assert yaml.safe_load((tmp_path / target).read_text())["margins"]
