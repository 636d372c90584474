"""A job waits for the files of other jobs that it reads, and its rule declares them all."""

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import is_dataclass
from inspect import getclosurevars, signature
from pathlib import Path
from pkgutil import resolve_name

import pytest
from examples import write
from rules import Job, every_job, job_of, rule_names, workflow
from studies import changed, lens_file, measurement, tiny_study, with_imported

from tasklens.runtime.checkpoints import Checkpoint
from tasklens.settings.lens_entries import LensDesign
from tasklens.study import claims, table_contents
from tasklens.study.loading import parse
from tasklens.study.study import TABLES, Study, StudyError

PAGE_JOBS = "verdicts_table", "psf_tail_table", "effort_table", "report_page"  # in addition to the tables


def makers_of(study: Study) -> dict[Path, tuple[tuple, Job]]:
    """The job that makes each file of a study, with its key."""
    return {path: (key, job) for key, job in every_job(study) for path in job.outputs.values()}


def needed_jobs(makers: dict[Path, tuple[tuple, Job]], targets: Sequence[Path]) -> set[tuple]:
    """Keys of all jobs that some files depend on by declared inputs."""
    needed, waiting = {}, list(targets)
    while waiting:
        path = waiting.pop()
        assert path in makers or path.parts[0] != "results", f"no job makes {path}"
        key, job = makers.get(path, (None, None))
        if key is not None and key not in needed:
            needed[key] = job
            waiting += job.reads
    return {*needed}


def test_a_design_by_contrast_waits_for_no_images():
    """It judges PSFs, so captures and images change nothing; a design by captures has both."""
    descents = [{"steps": 1, "criterion": "contrast"}]
    study = changed(tiny_study(), "designs.contrast", {"descents": descents, "augment": False})
    lens = {"lens": "singlet-contrast", "seed": 0}
    assert job_of("design", parse(study), **lens).inputs["train"] == []
    assert job_of("design", parse(study), **lens | {"lens": "singlet-image_error"}).inputs["train"] != []
    other = changed(study, "capture", {"sensor": {}})
    assert job_of("design", parse(study), **lens).settings == job_of("design", parse(other), **lens).settings


@pytest.mark.parametrize("table", ["table3", "table4"])
def test_lenses_of_other_tables_are_not_designed(table):
    """Table 4 needs no end-to-end design, and only restored lenses. Those of table 3 need the imaging lenses that they
    start from, but not the PSF tails of these lenses."""
    mapping = changed(tiny_study(), "elements.doublet", ["COC", "OKP4"])
    study = parse(mapping | {"tables": [table], "restored": ["doublet"]})
    contents = table_contents.table(study, table)
    elements = ["doublet"] if table == "table4" else ["singlet", "doublet"]
    designs = [name for name in study.designs if table == "table3" or not name.startswith("end_to_end")]
    others = [path for name in PAGE_JOBS for path in job_of(name, study).outputs.values()]
    made = [*job_of("table", study, table=table).outputs.values(), *others]
    makers = makers_of(study)
    for targets, measured_again in ((made, set()), (job_of("verify", study).reads, set(contents.measured))):
        jobs = needed_jobs(makers, targets)
        lenses = {rule: {job[1] for job in jobs if job[0] == rule} for rule in ("design", "reference", "restore")}
        assert lenses["design"] == set(map("-".join, itertools.product(elements, designs)))
        assert lenses["reference"] == {"small"}
        assert lenses["restore"] == (set(contents.lenses) if table == "table4" else set())
        assert {job[1:] for job in jobs if job[0] == "reproduce"} == measured_again


def test_what_a_job_reads_another_makes():
    """Or it is a file of the user or the paper's values. Inputs have the same seed, and are never own outputs."""
    study = parse(changed(with_imported(), "seeds", [0, 7]))
    jobs = list(every_job(study))
    output_paths = {path for _, job in jobs for path in job.outputs.values()}
    assert len(output_paths) == sum(len(job.outputs) for _, job in jobs)  # no two write one file
    for key, job in jobs:
        assert not set(job.reads) & set(job.outputs.values()), key
        assert all(path in output_paths or path.parts[0] != "results" for path in job.reads), key
        if "-seed" in job.log.stem:
            seeds = {part for path in job.reads for part in path.parts if part.startswith("seed")}
            assert seeds <= {f"seed{job.log.stem.rpartition('seed')[2]}"}, key


def test_a_lens_waits_for_what_it_needs():
    """By spots for nothing; by a network, and an imported lens, for the network; from imaging for the accuracies."""
    makers = makers_of(parse(with_imported()))
    for lens, counts in (
        ("singlet-imaging1", {"design": 1}),
        ("singlet-tasklens", {"design": 1, "images": 1, "reference": 1}),
        ("singlet-end_to_end_from_imaging", {"design": 4, "images": 1, "reference": 1, "psfs": 3, "fine_tune": 3}),
        ("quadruplet-phone", {"design": 1, "images": 1, "reference": 1}),
    ):
        assert Counter(rule for rule, *_ in needed_jobs(makers, [lens_file("tiny", lens)])) == counts


def test_no_design_starts_from_a_lens_that_stops_light():
    """A start has open apertures; without its apertures this would be another lens."""
    study = changed(tiny_study(), "designs.imaging2.vignetting", 0.3)
    assert table_contents.starts(parse(study), "singlet-end_to_end_from_imaging") == (
        "singlet-image_error",
        "singlet-imaging1",
    )
    with pytest.raises(StudyError, match=r"'imaging2' cannot be the start .* image_error, imaging1, end_to_end"):
        parse(changed(study, "designs.tasklens.start", ["imaging2"]))


JOINT = {"start": ["tasklens", "imaging2"], "batch_size": 2, "descents": [{"steps": 2, "network_learning_rate": 1e-3}]}


def test_a_joint_design_starts_from_the_best_after_fine_tuning():
    """It reads the accuracies of its candidates, one of them task-driven; a frozen design reads only the lenses."""
    study = parse(changed(tiny_study(), "designs.joint", JOINT))
    expected = ("singlet-tasklens", "singlet-imaging2")
    inputs = job_of("design", study, lens="singlet-joint", seed=3).inputs
    assert [*map(Path, inputs["starts"])] == [lens_file("tiny", name, 3) for name in expected]
    assert len(inputs["metrics"]) == 2
    frozen = changed(tiny_study(), "designs.frozen", JOINT | {"start": ["image_error", "imaging2"]})
    frozen = changed(frozen, "designs.frozen.descents", [{"steps": 2}])
    settings = table_contents.lens_design(parse(frozen), "singlet-frozen", 3)
    assert settings.starts == ("singlet-image_error", "singlet-imaging2")
    inputs = job_of("design", parse(frozen), lens="singlet-frozen", seed=3).inputs
    assert len(inputs["starts"]) == 2 and not inputs["metrics"]


def test_a_joint_design_is_task_driven_unless_it_comes_from_flat_plates():
    """From other lenses it is in every table and keeps the limits; from plates it is only in table 3 and may fail."""
    study = changed(tiny_study(), "designs.joint", JOINT)
    study = parse(changed(study, "designs.flat", JOINT | {"start": "flat", "descents": 2 * JOINT["descents"]}))
    table_lenses = {name: table_contents.table(study, name).lenses for name in TABLES}
    assert all("singlet-joint" in lenses for lenses in table_lenses.values())
    assert [name for name, lenses in table_lenses.items() if "singlet-flat" in lenses] == ["table3"]
    constrained = table_contents.verification(study).constrained
    assert "singlet-joint" in constrained and "singlet-flat" not in constrained
    lens_claims = {(claim.text, claim.lens, claim.baselines) for claim in claims.claims(study).claims}
    assert (claims.OVER_START, "singlet-joint", ("singlet-tasklens", "singlet-imaging2")) in lens_claims
    assert (claims.OVER_LEAST_SQUARES, "singlet-joint", ("singlet-imaging2",)) in lens_claims
    assert not any("singlet-flat" in claim[1] for claim in lens_claims)


def test_a_failed_job_gets_twice_the_memory_and_time():
    """Its estimates hold only for the first attempt."""
    needs = workflow().get_rule("design").resources
    first, second = (
        {key: needs[key].evaluate({}, attempt=attempt).value for key in ("mem_mb", "runtime")} for attempt in (1, 2)
    )
    assert second == {key: 2 * value for key, value in first.items()} and min(first.values()) > 0


@pytest.mark.parametrize("name", rule_names())
def test_a_rule_is_declared_in_one_piece(name):
    """It has a sentence, a typed function of its settings and files, and all wildcards in every file and its log."""
    rule = workflow().get_rule(name)
    assert rule.docstring.endswith(".") and rule.benchmark
    parameters = signature(resolve_name(rule.params.function)).parameters
    for group in [name for name, parameter in parameters.items() if is_dataclass(parameter.annotation)]:
        fields = signature(parameters[group].annotation).parameters
        parameters = {key: value for key, value in parameters.items() if key != group} | fields
    files = {*rule.input.keys(), *rule.output.keys()} | ({"benchmarks"} if name == "effort_table" else set())
    files |= {"optional", "drawn", "benchmarks"} if name == "report_page" else set()
    settings = getclosurevars(rule.params.settings).nonlocals.get("values", list(parameters)[:1])
    assert list(parameters)[: len(settings)] == list(settings) and not files & {*settings}
    assert {*parameters} - {*settings, "checkpoint"} == files
    assert all(parameter.annotation is not parameter.empty for parameter in parameters.values())
    for path in [*rule.output, *rule.log, rule.benchmark]:
        assert {*re.findall(r"{(\w+)", str(path))} == rule.wildcard_names


def test_a_job_is_given_its_settings_its_files_and_a_checkpoint_of_its_own(here, monkeypatch):
    """The checkpoint is removed when the job ends; an old one of the same job with other settings is removed first."""
    study, lens = parse(tiny_study()), "singlet-end_to_end_from_imaging"
    job = job_of("design", study, lens=lens, seed=4)
    for path in job.reads:
        write(path, "")
    folder = Path("results/tiny/checkpoints")
    other, another = folder / f"design-{lens}-seed4-{16 * 'a'}.pt", folder / f"design-{lens}-seed40-{16 * 'a'}.pt"
    for path in (other, another):
        write(path, "")
    arguments = {}

    def work(settings: LensDesign, train: Sequence[Path], weights: Path | None, files: Sequence[Path],
             starts: Sequence[Path], metrics: Sequence[Path], lens: Path, history: Path,
             checkpoint: Checkpoint):  # fmt: skip
        arguments.update(locals())
        write(checkpoint.path, "")

    monkeypatch.setattr("tasklens.study.jobs.design_lens.run", work)
    job.run()
    assert arguments["settings"] == table_contents.lens_design(study, lens, 4)
    assert arguments["weights"] == Path("results/tiny/classifiers/reference/small.safetensors")
    starts = "singlet-image_error", "singlet-imaging1", "singlet-imaging2"
    assert arguments["starts"] == [lens_file("tiny", name, 4) for name in starts]
    assert arguments["metrics"] == [measurement("tiny", name, "small", 4) for name in starts]
    assert arguments["history"] == lens_file("tiny", lens, 4, "history.csv")
    assert re.fullmatch(rf"design-{lens}-seed4-[0-9a-f]{{16}}\.pt", arguments["checkpoint"].path.name)
    assert list(folder.iterdir()) == [another]
