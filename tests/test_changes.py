"""Changed values of a study: how they are told, and which finished results of the last run they would overwrite."""

import json
from dataclasses import replace

import pytest
from examples import changed, tiny_study, write

from tasklens.pipeline import report_jobs  # noqa: F401  declares the stages, with those of `jobs`
from tasklens.pipeline.changes import COUNTED, Change, PlannedJob, amount, changes, overwritten, refusal
from tasklens.pipeline.forecast import Durations
from tasklens.pipeline.stage import STAGES
from tasklens.study.loading import dump, parse, resolved
from tasklens.study.study import Study

LENSES = ("imaging1", "imaging2")


def base() -> dict:
    """Two lenses without images, three classifiers."""
    study = tiny_study()
    third = study["classifiers"]["small"]
    return study | {
        "designs": {name: study["designs"][name] for name in LENSES},
        "classifiers": study["classifiers"] | {"third": third},
    }


def jobs_of(study: Study, missing: tuple[str, ...] = ()) -> dict[str, PlannedJob]:
    """All jobs of table 1 and of the other classifiers, as Snakemake would plan them where each is to run."""
    jobs = {"images": PlannedJob("images", {}, True, ())}
    for name in study.classifiers:
        jobs[f"reference/{name}"] = PlannedJob("reference", {"classifier": name}, True, ("images",))
    for lens in study.lenses:
        for seed in study.seeds:
            wildcards, label = {"lens": lens, "seed": str(seed)}, f"{lens}-seed{seed}"
            jobs[f"design/{label}"] = PlannedJob("design", wildcards, True, ())
            needs = ("images", f"design/{label}", f"reference/{study.supervisor}")
            measured = wildcards | {"measured_name": study.supervisor}
            jobs[f"fine_tune/{label}"] = PlannedJob("fine_tune", measured, True, needs)
            others = [f"reference/{name}" for name in study.classifiers if name != study.supervisor]
            needs = ("images", f"design/{label}", *others)
            jobs[f"fine_tune_others/{label}"] = PlannedJob("fine_tune_others", wildcards, True, needs)
    jobs["table/table1"] = PlannedJob("table", {"table": "table1"}, True, tuple(jobs))
    return {k: PlannedJob(j.stage, j.wildcards, k not in missing, j.needs) for k, j in jobs.items()}


@pytest.fixture
def found(tmp_path):
    """What a changed study would overwrite, where every job of the first one is finished but `missing`."""
    stored = tmp_path / "study.yaml"
    before = parse(base())
    write(stored, dump(before))

    def find(after: dict, missing: tuple[str, ...] = (), only: tuple[str, ...] = ()):
        after = parse(after)
        new = tuple(jobs_of(after).keys() - jobs_of(before).keys())
        jobs = {k: job for k, job in jobs_of(after, (*missing, *new)).items() if not only or job.stage in only}
        return overwritten(stored, after, jobs)

    return find


def said(found, study: dict, tmp_path, cores: int = 1) -> list[str]:
    text = refusal(found, parse(study), Durations("tiny", str(tmp_path)), cores)
    return [] if text is None else text.splitlines()


@pytest.mark.parametrize(
    "key, value, words",
    [
        ("spec.f_number", 2.0, "spec.f_number: 2.8 -> 2.0"),
        ("seeds", [0, 1], "seeds: [0] -> [0, 1]"),
        ("restored", ["singlet"], "restored: null -> [singlet]"),
        ("elements.mine", ["COC", "COC"], "elements.mine: null -> [COC, COC]"),
        ("designs.imaging3", tiny_study()["designs"]["imaging1"], "designs.imaging3: added"),
        ("images.folder", "/a" + 40 * "/photographs", "images.folder: null -> /a/photographs"),
    ],
)
def test_a_changed_value_is_told_in_one_line(key, value, words):
    """By its dotted key; nothing else differs, defaults neither."""
    (change,) = changes(resolved(parse(base())), resolved(parse(changed(base(), key, value))))
    assert str(change).startswith(words) and len(str(change)) < 100 and "\n" not in str(change)


def test_changes_are_those_of_the_values_alone():
    """The same values in another order are none; what is gone is told from what it was."""
    study = base()
    assert changes(resolved(parse(study)), resolved(parse(dict(reversed(study.items()))))) == []
    gone = changes({"a": {"b": {"c": 1}, "d": 2}}, {"a": {"d": 2}})
    assert gone == [Change("a.b", {"c": 1}, None)] and str(gone[0]) == "a.b: removed"


def test_a_changed_value_overwrites_what_reads_it(found, tmp_path):
    """F/2 in place of F/2.8: both lenses and what was measured through them; the networks of sharp images stay."""
    after = changed(base(), "spec.f_number", 2.0)
    only = ("design", "fine_tune", "fine_tune_others", "table")  # Snakemake plans no others
    write(tmp_path / "benchmarks/design/a.tsv", "s\tmax_rss\n300\t1\n")
    head, line, *ways = said(found(after, only=only), after, tmp_path, cores=2)
    assert "finished results of the study tiny" in head and "nothing was changed" in head
    # two lenses of 5 minutes on two cores; each measured by the supervisor and by two other networks
    assert line == "  spec.f_number: 2.8 -> 2.0: 2 lenses, 6 classifiers again, 5 min"
    assert "--config name=tiny_2" in ways[0] and "--config overwrite=true" in ways[1]


def test_several_changed_values_are_told_together(found, tmp_path):
    """The first ten of them, and how many more."""
    after = changed(changed(base(), "spec.f_number", 2.0), "constraints.max_track", 4.2)
    first, second, total = (line.strip() for line in said(found(after), after, tmp_path)[1:-2])
    assert {first.split(":")[0], second.split(":")[0]} == {"spec.f_number", "constraints.max_track"}
    assert total == "together: 2 lenses, 6 classifiers again"
    for k in range(10):
        after = changed(after, f"elements.mine{k}", ["COC"])
    lines = said(found(after), after, tmp_path)
    assert lines[11:-2] == ["  and 2 more changed values", "  together: 2 lenses, 6 classifiers again"]


def test_what_takes_long_is_not_overwritten_without_consent():
    """All that is resumed where it was killed, but images, which are made of nothing else, and reproductions."""
    long = {stage.name for stage in STAGES.values() if stage.resumable} - {"images", "reproduce"}
    assert set(COUNTED) == long


@pytest.mark.parametrize(
    "key, value, counts",
    [
        ("fine_tuning.learning_rate", 5e-3, {"fine_tune": 2, "fine_tune_others": 2}),
        ("designs.imaging1.descents.0.steps", 9, {"design": 1, "fine_tune": 1, "fine_tune_others": 1}),
        ("classifiers.small.training.learning_rate", 2e-3, {"reference": 1, "fine_tune": 2}),
        ("classifiers.third.training.learning_rate", 2e-3, {"reference": 1, "fine_tune_others": 2}),
        ("images.seed", 4, {"reference": 3, "fine_tune": 2, "fine_tune_others": 2}),
        ("restoration.steps", 9, {}),
        ("tables", ["table1"], {}),
    ],
)
def test_only_what_depends_on_a_changed_value_is_asked_about(found, key, value, counts):
    stages = found(changed(base(), key, value)).by_values
    assert {stage: stages.count(stage) for stage in stages} == counts


@pytest.mark.parametrize(
    "key, value",
    [
        ("seeds", [0, 1, 2]),
        ("elements.doublet", ["COC", "OKP4"]),
        ("designs.imaging3", tiny_study()["designs"]["imaging1"]),
        ("classifiers.fourth", tiny_study()["classifiers"]["small"]),
    ],
)
def test_what_is_added_asks_nothing(found, tmp_path, key, value):
    """Further seeds, lenses or classifiers, though classifiers are measured beside each other again."""
    after = changed(base(), key, value)
    assert found(after).by_values == () and said(found(after), after, tmp_path) == []


def test_what_is_not_finished_asks_nothing(found, tmp_path):
    """Neither a study that never ran, nor jobs without results, nor those of a table."""
    after = changed(base(), "spec.f_number", 2.0)
    none = tuple(jobs_of(parse(base())))
    assert said(found(after, missing=none), after, tmp_path) == []
    assert said(found(after, only=("table",)), after, tmp_path) == []
    study = parse(after)
    assert overwritten(tmp_path / "absent.yaml", study, jobs_of(study)).by_values == ()


def test_a_removed_result_does_not_hide_what_is_made_of_it(found):
    """The lens was deleted, the networks fine-tuned on it were not: a changed spec would overwrite these."""
    missing = tuple(f"design/singlet-{name}-seed0" for name in LENSES)
    after = changed(base(), "constraints.max_track", 4.2)
    assert sorted(found(after, missing=missing).by_values) == 2 * ["fine_tune"] + 2 * ["fine_tune_others"]


def test_changed_code_is_told_but_not_asked_about(found, tmp_path):
    """With equal values every job runs for another reason, which Snakemake knows."""
    same = found(base())
    assert same.changes == () and same.by_values == () and said(same, base(), tmp_path) == []
    assert amount(same.otherwise, parse(base()), Durations("tiny", str(tmp_path)), 1) == "2 lenses, 9 classifiers again"


def test_settings_of_the_outputs_count_where_they_are_known(found, tmp_path):
    """The study was stored by a run that left the lens alone, which was made before with two steps."""
    after = parse(changed(base(), "designs.imaging1.descents.0.steps", 3))
    label = next(label for label in jobs_of(after) if label.startswith("design/"))
    job = jobs_of(after)[label]
    made = json.loads(STAGES["design"].plan_from(after, job.wildcards).settings.model_dump_json())
    write(tmp_path / "now.yaml", dump(after))
    same = overwritten(tmp_path / "now.yaml", after, {label: replace(job, made_with=made)})
    assert same.by_values == () and same.otherwise == ("design",)
    made["entry"]["design"]["descents"][0]["steps"] = 2
    other = overwritten(tmp_path / "now.yaml", after, {label: replace(job, made_with=made)})
    assert other.by_values == ("design",)
    (head, line, *_) = refusal(other, after, Durations("tiny", str(tmp_path)), 1).splitlines()
    assert "finished results" in head and line == "  entry.design.descents.0.steps: 2 -> 3: 1 lens again"


def test_a_stored_study_of_another_version_is_asked_about(found, tmp_path):
    """What it was made with cannot be known."""
    write(tmp_path / "study.yaml", "format: 1\nname: tiny\n")
    lines = said(found(base()), base(), tmp_path)
    assert "finished results" in lines[0] and any("format: 1 -> 3" in line for line in lines)
