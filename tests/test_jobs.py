"""Jobs: which of them reads what of the study, and which files of which others."""

import itertools
import string
from collections.abc import Iterator
from importlib import import_module
from inspect import getmembers, isfunction, signature
from pathlib import Path
from re import fullmatch

import pytest
import torch
import yaml
from examples import changed, finish, tiny_study, with_imported, write
from safetensors.torch import load_file

from tasklens.cli import run as commands
from tasklens.materials.catalogues import builtin
from tasklens.pipeline import digest, figure_jobs, jobs, report_jobs, run
from tasklens.pipeline import stage as stages
from tasklens.pipeline.stage import STAGES, Plan, Stage, flatten
from tasklens.runtime import files
from tasklens.runtime.files import FileError, Files
from tasklens.study import claims, names, tables
from tasklens.study.loading import dump, load, parse
from tasklens.study.names import SHARP
from tasklens.study.settings import Slice
from tasklens.study.study import TABLES, Study, StudyError

ROOT = Path(__file__).parents[1]
TOLD = report_jobs.verdicts, report_jobs.psf_tail, report_jobs.effort, report_jobs.report  # beside the tables


def wildcards_of(stage: Stage, study: Study) -> Iterator[dict]:
    """The wildcards of every job that a stage has in a study."""
    every_lens = [*study.lenses, *study.variants]
    measures = stage in (jobs.fine_tune, jobs.fine_tune_others, jobs.reproduce, jobs.task_fine_tune)
    made_with_others = jobs.others(study) if stage is jobs.fine_tune else []
    ranges = {
        "lens": [SHARP, *every_lens] if measures else every_lens,
        "classifier": study.classifiers,
        "measured_name": [*study.classifiers, *map(names.restored, study.classifiers)],
        "table": TABLES,
        "ablation": study.ablations,
        "elements": dict.fromkeys(study.lens(claim.lens).elements for claim in claims.regime_claims(study).claims),
        "task": study.tasks.networks,
        "seed": study.seeds,
    }
    for values in itertools.product(*(ranges[name] for name in stage.wildcards)):
        found = dict(zip(stage.wildcards, values, strict=True))
        name = found.get("measured_name", "")
        if name not in made_with_others and not (found.get("lens") == SHARP and names.split(name)[1]):
            yield found  # sharp images are not restored


def every_job(study: Study) -> Iterator[tuple[tuple, Stage, dict]]:
    """Name of the stage and wildcards but for the seed; the stage; its wildcards."""
    for stage in STAGES.values():
        if callable(stage.patterns) and not stage.outputs(study):
            continue  # the study has no such jobs
        if stage in (report_jobs.tolerances, jobs.production) and study.capture.diffraction:
            continue  # refused: see below
        for found in wildcards_of(stage, study):
            yield (stage.name, *(value for name, value in found.items() if name != "seed")), stage, found


def slices(mapping: dict) -> dict[tuple, list[str]]:
    """What Snakemake compares, for every job of a study; of each seed."""
    study, found = parse(mapping), {}
    for key, stage, wildcards in every_job(study):
        found.setdefault(key, []).append(stage.plan(study, **wildcards).settings.model_dump_json())
    return found


def needed(study: Study, *targets: Path) -> set[tuple]:
    """All jobs that some files wait for, by the inputs that are declared; those of every seed once."""
    makers = {}
    for key, stage, wildcards in every_job(study):
        for path in stage.outputs(study, **wildcards).values():
            assert path not in makers, f"two jobs write {path}"
            makers[path] = key, stage, wildcards
    found, waiting = {}, list(targets)
    while waiting:
        path = waiting.pop()
        if path not in makers:
            assert path.parts[0] != "results", f"no job makes {path}"
            continue
        key, stage, wildcards = makers[path]
        if (key, wildcards.get("seed")) not in found:
            found[key, wildcards.get("seed")] = key
            waiting += flatten(stage.plan(study, **wildcards).inputs)
    return set(found.values())


CLASSIFIED = ("singlet-tasklens", "singlet-end_to_end_from_imaging", "singlet-end_to_end_from_flat")
SUPERVISED = (*CLASSIFIED, "singlet-image_error")
RESTORED = ("small-restored", "other-restored")


def measured(*measured_names: str):
    """Whether a job measures one of these, anew or again."""
    return lambda job: (
        (job[0] in ("fine_tune", "reproduce") and job[2] in measured_names)
        or (job[0] == "fine_tune_others" and "other" in measured_names)
    )


READERS = [
    ("fine_tuning.learning_rate", 3e-3, lambda job: job[0] in ("fine_tune", "fine_tune_others")),
    ("images.seed", 5, lambda job: job == ("images",)),
    ("evaluation_rays", 128, lambda job: job[0] in ("psf_tail", "design")),
    ("spec.pixel_pitch_um", 2.0, lambda job: job[0] in ("psf_tail", "design", "production")),
    ("constraints.max_track", 4.0, lambda job: job[0] == "design"),
    ("constraints.flat_track", 1.2, lambda job: job[0] == "design"),
    ("designs.imaging1.descents.0.steps", 4,
     lambda job: job in (("design", "singlet-imaging1"), ("effort",), ("regimes",))),
    ("restoration.steps", 9, lambda job: job[0] in ("restore", "captures") or measured(*RESTORED)(job)),
    ("restored", [], lambda job: job in (("table", "table4"), ("verdicts",), ("verify",), ("captures",))),
    ("capture.outside_window", "renormalise",
     lambda job: job[0] in ("restore", "captures", "frames", "production")
     or (job[0] in ("fine_tune", "fine_tune_others", "reproduce") and job[1] != SHARP)
     or (job[0] == "design" and job[1] in SUPERVISED)),
    ("classifiers.small.training.learning_rate", 2e-3,
     lambda job: job in (("reference", "small"), ("captures",)) or measured("small", "small-restored")(job)
     or job[0] == "production" or (job[0] == "design" and job[1] in CLASSIFIED)),
    ("classifiers.other.model", "test_vit2",
     lambda job: job in (("reference", "other"), ("captures",)) or measured("other", "other-restored")(job)),
    ("tolerances.grade", "phone_moulding", lambda job: job[0] in ("certificate", "production", "tolerances")),
    ("tolerances.images", 10, lambda job: job[0] in ("production", "tolerances")),
    ("tolerances.designs", ["imaging1"], lambda job: job == ("tolerances",)),
    ("elements.singlet", ["PMMA"], lambda job: job[0] == "design"),
]  # fmt: skip


@pytest.mark.parametrize("key, value, reads", READERS, ids=[key for key, *_ in READERS])
def test_a_changed_value_reaches_the_jobs_that_read_it_and_no_others(key, value, reads):
    before, after = slices(tiny_study()), slices(changed(tiny_study(), key, value))
    assert before.keys() == after.keys()
    touched = {job for job in before if before[job] != after[job]}
    assert touched - {("report",)} == {job for job in before if reads(job)} != set()
    assert ("report",) in touched  # it shows the whole configuration


def test_diffraction_changes_no_design():
    """It adds a job for each lens, whose PSFs are those of training, restoration and measurement."""
    study = parse(changed(tiny_study(), "capture", {"diffraction": True}))
    before, after = slices(tiny_study()), slices(changed(tiny_study(), "capture", {"diffraction": True}))
    assert {job for job in after if job not in before} == {("diffraction", lens) for lens in study.lenses}
    assert all(after[job] == before[job] for job in before if job[0] == "design")
    psf = jobs.diffraction.output(study, "psf", lens="singlet-imaging1", seed=0)
    for stage, rest in (("fine_tune", {"measured_name": "small"}), ("fine_tune_others", {}), ("restore", {})):
        assert STAGES[stage].plan(study, lens="singlet-imaging1", seed=0, **rest).inputs["psf"] == psf
    with pytest.raises(StudyError, match="tolerances: lenses are built by rays alone"):
        report_jobs.tolerances.plan(study)
    with pytest.raises(StudyError, match="tolerances: lenses are built by rays alone"):
        jobs.production.plan(study, lens="singlet-imaging1", seed=0)


def test_a_network_of_another_seed(tmp_path, monkeypatch):
    """It has other weights, and lenses for image quality are not designed again."""
    monkeypatch.chdir(tmp_path)
    given = tiny_study()
    other = changed(given, "classifiers.small.seed", 1) | {"name": "other"}
    studies = [parse(each) for each in (given, other, given | {"name": "same"})]
    for study in studies:
        finish(jobs.images, study)
    first, second, same = (load_file(finish(jobs.reference, study, classifier="small").weights) for study in studies)
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not any(torch.equal(first[name], second[name]) for name in first if name.endswith("conv1.weight"))
    before, after = slices(given), slices(other | {"name": given["name"]})
    touched = {job[1] for job in before if before[job] != after[job] and job[0] == "design"}
    assert touched == {each[1] for each in before if each[0] == "design" and ("task" in each[1] or "end_to" in each[1])}


def test_editing_a_plastic_redesigns_the_lenses_that_use_it_and_no_others():
    study = changed(tiny_study(), "elements", {"doublet": ["OKP4", "MINE"], "singlet": ["COC"]})
    mine = builtin("COC").definition()
    before = slices(study | {"materials": {"MINE": mine}})
    after = slices(study | {"materials": {"MINE": mine | {"coefficients": [2.31, 0.01, 0.037, 0, 0, 0]}}})
    touched = {job for job in before if before[job] != after[job]} - {("report",)}
    assert touched == {job for job in before if job[0] == "design" and job[1].startswith("doublet")}


def test_tables_hold_the_lenses_of_the_paper():
    """Task-driven against imaging; in table 3 against end-to-end; in table 2 with all classifiers."""
    study = parse(tiny_study())
    found = {name: report_jobs.table.plan(study, name).settings for name in TABLES}
    imaging = ("singlet-tasklens", "singlet-image_error", "singlet-imaging1", "singlet-imaging2")
    assert all(found[name].lenses == imaging for name in ("table1", "table2", "table4"))
    assert found["table3"].lenses == CLASSIFIED
    assert found["table2"].classifiers == ("small", "other")
    assert all(found[name].classifiers == ("small",) for name in ("table1", "table3", "table4"))


def test_a_study_may_make_some_of_the_tables():
    """Its tails, verdicts and verification are of these, of their lenses and of their measurements."""
    some = changed(tiny_study(), "tables", ["table3"])
    before, after = slices(tiny_study()), slices(some)
    told = {("psf_tail",), ("merit_function",), ("verdicts",), ("verify",), ("captures",), ("report",)}
    assert {job for job in before if before[job] != after[job]} == told
    study = parse(some)
    verified = report_jobs.verify.plan(study).settings
    assert report_jobs.psf_tail.plan(study).settings.lenses == verified.lenses == CLASSIFIED
    assert {classifier for _, classifier in verified.measured} == {"small"}
    assert {claim.table for claim in report_jobs.verdicts.plan(study).settings.claims} == {"table3"}
    assert {claim.table for claim in report_jobs.verdicts.plan(parse(tiny_study())).settings.claims} == {*TABLES}


IMAGE_QUALITY = {"image_error", "image_contrast", "image_correlation", "image_psnr", "imaging1", "imaging2", "imaging3"}
IMAGING_AND_TASK = IMAGE_QUALITY | {"tasklens", "tasklens_from_quality", "tasklens_joint"}


@pytest.mark.parametrize("target", ["tables", "verify"])
@pytest.mark.parametrize(
    "made, elements, designs, restorations",
    [
        ("table1", ("doublet", "triplet", "quadruplet"), IMAGING_AND_TASK, 0),
        ("table3", ("doublet", "triplet", "quadruplet"),
         IMAGING_AND_TASK | {"end_to_end_from_imaging", "end_to_end_from_flat"}, 0),
        ("table4", ("doublet",), IMAGING_AND_TASK, 10),
    ],
)  # fmt: skip
def test_lenses_of_other_tables_are_not_designed(target, made, elements, designs, restorations):
    """Table 1 waits for no end-to-end design; those of table 3 wait for the imaging lenses that they start from, though
    not for the PSF tails of these."""
    study = load(ROOT / "config" / "config.yaml").model_copy(update={"tables": (made,)})
    contents = tables.table(study, made)
    if target == "verify":
        found = needed(study, *flatten(report_jobs.verify.plan(study).inputs))
        assert {job[1:] for job in found if job[0] == "reproduce"} == set(contents.measured)
    else:
        others = (next(iter(stage.outputs(study).values())) for stage in TOLD)
        found = needed(study, report_jobs.table.output(study, "csv", table=made), *others)
    expected = set(map("-".join, itertools.product(elements, designs)))
    assert {job[1] for job in found if job[0] == "design"} == expected
    assert {job[1] for job in found if job[0] == "reference"} == {"resnet"}
    assert len({job for job in found if job[0] == "restore"}) == restorations


@pytest.mark.parametrize("mapping", [tiny_study(), with_imported(), changed(tiny_study(), "seeds", [0, 7])])
def test_what_a_job_reads_another_makes(mapping):
    """Or it is a file of the user, or the paper's values; of the same seed, and never its own output."""
    study = parse(mapping)
    for key, stage, wildcards in every_job(study):
        reads = set(flatten(stage.plan(study, **wildcards).inputs))
        needed(study, *reads)
        assert not reads & set(stage.outputs(study, **wildcards).values()), key
        if stage.wildcards[-1:] == ("seed",):
            others = [f"seed{seed}" for seed in study.seeds if seed != wildcards["seed"]]
            assert not [path for path in reads if any(part in path.parts for part in others)], key


def test_an_imported_lens_adds_rows_and_changes_no_other_job():
    """It stands beside the imaging designs, last; nothing starts from it, and its own design reads no classifier."""
    before, after = slices(tiny_study()), slices(with_imported())
    rows = {("table", name) for name in ("table1", "table2", "table4")}
    told = ("psf_tail", "effort", "merit_function", "tolerances", "verify", "captures", "report")
    rows |= {(stage,) for stage in told}
    assert {job for job in before if before[job] != after[job]} == rows
    assert all("quadruplet-phone" in job for job in after.keys() - before.keys())
    study = parse(with_imported())
    for name in TABLES:
        imported = () if name == "table3" else ("quadruplet-phone",)
        assert tables.table(study, name).lenses == tables.table(parse(tiny_study()), name).lenses + imported
    plan = jobs.design.plan(study, "quadruplet-phone", 0)
    assert plan.settings.classifier is None and plan.inputs["weights"] is None and plan.inputs["train"] is None
    assert plan.inputs["files"] == [study.imported["phone"].file]
    assert tables.starts(study, "quadruplet-phone") == ()
    assert not any("phone" in str(path) for path in flatten(jobs.design.plan(study, SUPERVISED[1], 0).inputs))


def test_baselines_are_the_imaging_lenses_of_the_same_elements():
    """An end-to-end design from imaging reads them and their accuracies of its own seed; no other design reads any."""
    study = parse(changed(tiny_study(), "elements.doublet", ["COC", "OKP4"]))
    expected = ("doublet-image_error", "doublet-imaging1", "doublet-imaging2")
    assert tables.starts(study, "doublet-end_to_end_from_imaging") == expected
    assert tables.starts(study, "doublet-end_to_end_from_flat") == ()
    assert tables.starts(study, "doublet-tasklens") == ()
    inputs = jobs.design.plan(study, "doublet-end_to_end_from_imaging", 3).inputs
    assert inputs["starts"] == {name: Path(f"results/tiny/lenses/{name}/seed3/lens.yaml") for name in expected}
    assert inputs["metrics"] == {name: Path(f"results/tiny/metrics/{name}/seed3/small.csv") for name in expected}
    for name in ("end_to_end_from_flat", "tasklens", "imaging1"):
        inputs = jobs.design.plan(study, f"doublet-{name}", 3).inputs
        assert inputs["starts"] == inputs["metrics"] == {}


def test_no_design_starts_from_a_lens_that_stops_light():
    """Its apertures are opened in a start, and would make another lens of it."""
    study = changed(tiny_study(), "designs.imaging2.vignetting", 0.3)
    assert tables.starts(parse(study), "singlet-end_to_end_from_imaging") == ("singlet-image_error", "singlet-imaging1")
    with pytest.raises(StudyError, match=r"'imaging2' is not one of .*, image_error, imaging1, end_to_end"):
        parse(changed(study, "designs.tasklens.start", ["imaging2"]))


JOINT = {
    "start": ["tasklens", "imaging2"],
    "batch_size": 2,
    "descents": [{"steps": 2, "network_learning_rate": 1e-3}],
}


def test_a_joint_design_starts_from_the_best_after_fine_tuning():
    """It reads the accuracies of its candidates, one task-driven; a frozen one reads the lenses alone."""
    study = parse(changed(tiny_study(), "designs.joint", JOINT))
    expected = ("singlet-tasklens", "singlet-imaging2")
    inputs = jobs.design.plan(study, "singlet-joint", 3).inputs
    assert tuple(inputs["starts"]) == tuple(inputs["metrics"]) == expected and not inputs["candidates"]
    frozen = changed(tiny_study(), "designs.frozen", JOINT | {"start": ["image_error", "imaging2"]})
    frozen = changed(frozen, "designs.frozen.descents", [{"steps": 2}])
    inputs = jobs.design.plan(parse(frozen), "singlet-frozen", 3).inputs
    assert tuple(inputs["candidates"]) == ("singlet-image_error", "singlet-imaging2") and not inputs["starts"]


def test_a_joint_design_is_task_driven_unless_it_comes_from_flat_plates():
    """From other lenses it is in every table and keeps the limits; from plates in table 3 alone, where it may fail."""
    study = changed(tiny_study(), "designs.joint", JOINT)
    study = parse(changed(study, "designs.flat", JOINT | {"start": "flat", "descents": 2 * JOINT["descents"]}))
    found = {name: tables.table(study, name).lenses for name in TABLES}
    assert all("singlet-joint" in lenses for lenses in found.values())
    assert [name for name, lenses in found.items() if "singlet-flat" in lenses] == ["table3"]
    constrained = tables.verification(study).constrained
    assert "singlet-joint" in constrained and "singlet-flat" not in constrained
    claimed = {(claim.text, claim.lens, claim.baselines) for claim in claims.claims(study).claims}
    assert (claims.OVER_START, "singlet-joint", ("singlet-tasklens", "singlet-imaging2")) in claimed
    assert (claims.OVER_LEAST_SQUARES, "singlet-joint", ("singlet-imaging2",)) in claimed
    assert not any("singlet-flat" in claim[1] for claim in claimed)


def test_a_specification_of_its_own_changes_the_lenses_of_these_elements_alone():
    """Other designs, tails and focal lengths to verify for doublets, which are no baselines of singlets then."""
    study = changed(tiny_study(), "elements.doublet", ["COC", "OKP4"])
    before, after = slices(study), slices(changed(study, "specs", {"doublet": {"field_of_view_deg": 60.0}}))
    found = {job for job in before if before[job] != after[job]}
    doublets = {job for job in before if job[0] in ("design", "production") and job[1].startswith("doublet")}
    assert found == doublets | {("psf_tail",), ("verdicts",), ("verify",), ("report",)}
    both = parse(changed(study, "specs", {"doublet": {"field_of_view_deg": 60.0}}))
    efl_mm = report_jobs.verify.plan(both).settings.efl_mm
    assert efl_mm["singlet-imaging1"] == both.spec.efl_mm < efl_mm["doublet-imaging1"]
    assert parse(yaml.safe_load(dump(both))) == both


# ---- what a stage declares


@pytest.mark.parametrize("stage", STAGES.values(), ids=STAGES)
def test_a_stage_is_declared_in_one_piece(stage):
    """It has a sentence, a function, and wildcards that are all in the names of its jobs and of every output."""
    assert any(stage is getattr(module, stage.name, None) for module in (jobs, figure_jobs, report_jobs))
    assert stage.plan.__doc__.endswith(".")
    module, _, name = stage.function.rpartition(".")
    function = getattr(import_module(module), name)
    parameters = list(signature(function).parameters)
    assert parameters[1:] == ["inputs", "outputs", *(["checkpoint"] if stage.resumable else [])]
    assert digest.code_digest(stage.function)
    for pattern in [*stage.patterns_in(parse(tiny_study())).values(), stage.label]:
        found = {name for _, name, _, _ in string.Formatter().parse(pattern) if name is not None}
        assert found == set(stage.wildcards)


def test_every_function_among_the_stages_is_a_stage():
    """And no two stages have one function, or write one file."""
    found = []
    for path in (ROOT / "tasklens" / "pipeline" / "stages").glob("*.py"):
        name = f"tasklens.pipeline.stages.{path.stem}"
        public = getmembers(import_module(name), lambda value: isfunction(value) and value.__name__[0] != "_")
        found += [f"{name}.{key}" for key, value in public if value.__module__ == name]
    functions = [stage.function for stage in STAGES.values()]
    study = parse(tiny_study())
    assert set(found) == {name for name in functions if not name.startswith("tasklens.report.")}
    assert len(set(functions)) == len(functions)
    patterns = [pattern for stage in STAGES.values() for pattern in stage.patterns_in(study).values()]
    assert len(set(patterns)) == len(patterns)


def test_a_new_stage_takes_a_declaration_and_a_function(tmp_path, monkeypatch):
    """Its command, its files, and what is said of a missing input follow from these."""
    monkeypatch.setattr(stages, "STAGES", {})
    monkeypatch.setattr(commands, "STAGES", stages.STAGES)

    @stages.stage("tasklens.runtime.files.polish_glass", {"report": "polish/{lens}/seed{seed}.txt"})
    def polish_glass(study: Study, lens: str, seed: int) -> Plan:
        """Polish a lens."""
        return Plan(Slice(lens=study.lens(lens).name, seed=seed), {"lens": Path(f"{lens}.yaml")})

    def work(settings: Slice, inputs: Files, outputs: Files) -> None:
        write(outputs.report, f"{settings} {inputs.lens.read_text()}")

    monkeypatch.setattr(files, "polish_glass", work, raising=False)
    monkeypatch.chdir(tmp_path)
    write("study.yaml", yaml.safe_dump(tiny_study()))
    command = ["polish-glass", "study.yaml", "singlet-imaging1", "--seed", "3"]
    with pytest.raises(FileError, match=r"polish_glass/singlet-imaging1-seed3: missing input singlet-imaging1\.yaml"):
        commands.app()(command, standalone_mode=False)
    write("singlet-imaging1.yaml", "glass")
    commands.app()(command, standalone_mode=False)
    expected = "lens='singlet-imaging1' seed=3 glass"
    assert Path("results/tiny/polish/singlet-imaging1/seed3.txt").read_text() == expected


def test_a_job_is_given_its_slice_its_files_and_a_checkpoint_of_its_own(tmp_path, monkeypatch):
    """It is removed when the job ends; before, one of a job of the same name that computed something else."""
    monkeypatch.chdir(tmp_path)
    study = parse(tiny_study())
    lens = "singlet-end_to_end_from_imaging"
    plan = jobs.design.plan(study, lens, 4)
    words = f"^design/{lens}-seed4: missing input results/tiny/images/train.npy and 8 more; `snakemake` makes"
    with pytest.raises(FileError, match=words):
        run.run(jobs.design, study, {"lens": lens, "seed": 4})
    for path in flatten(plan.inputs):
        write(path, "")
    folder = Path("results/tiny/checkpoints")
    other, another = folder / f"design-{lens}-seed4-{16 * 'a'}.pt", folder / f"design-{lens}-seed40-{16 * 'a'}.pt"
    for path in (other, another):
        write(path, "")
    given = []

    def work(*arguments):
        given.extend(arguments)
        write(arguments[3].path, "")

    monkeypatch.setattr("tasklens.pipeline.stages.design.run", work)
    run.run(jobs.design, study, {"lens": lens, "seed": 4})
    settings, inputs, outputs, checkpoint = given
    assert settings == plan.settings and vars(inputs) == plan.inputs
    assert vars(outputs) == {
        "lens": Path(f"results/tiny/lenses/{lens}/seed4/lens.yaml"),
        "history": Path(f"results/tiny/lenses/{lens}/seed4/history.csv"),
        "psf": Path(f"results/tiny/lenses/{lens}/seed4/psf.safetensors"),
    }
    assert fullmatch(rf"design-{lens}-seed4-[0-9a-f]{{16}}\.pt", checkpoint.path.name)
    assert list(folder.iterdir()) == [another]
    with pytest.raises(StudyError, match="nobody"):
        run.run(jobs.reference, study, {"classifier": "nobody"})
