"""Changed values of a study: how they are reported, and which finished results they would overwrite."""

from dataclasses import replace
from inspect import signature
from pkgutil import resolve_name

import pytest
from examples import write
from rules import job_of, rule_names, workflow
from studies import changed, tiny_study

from tasklens.study.loading import dump, parse, resolve
from tasklens.study.run.changes import (
    COUNTED,
    Change,
    PlannedJob,
    amount,
    changes,
    find_overwritten,
    find_unrecorded,
    refusal,
)
from tasklens.study.run.forecast import Durations
from tasklens.study.study import Study

LENSES = ("imaging1", "imaging2")
pytestmark = pytest.mark.usefixtures("here")


def base() -> dict:
    """Two lenses without images, three classifiers."""
    study = tiny_study()
    study["classifiers"]["third"] = study["classifiers"]["small"]
    return study | {"designs": {name: study["designs"][name] for name in LENSES}}


def jobs_of(study: Study) -> dict[str, PlannedJob]:
    """All jobs of tables 1 and 2, as Snakemake plans them if every job has to run."""
    jobs: dict[str, PlannedJob] = {}

    def add(label: str, *needs: str, **wildcards: str | int) -> None:
        settings = job_of(label.partition("/")[0], study, **wildcards).settings
        jobs[label] = PlannedJob("tiny", label, True, ("file",), needs, settings, settings)

    add("images")
    for name in study.classifiers:
        add(f"reference/{name}", "images", classifier=name)
    for lens in study.lenses:
        for seed in study.seeds:
            add(f"design/{lens}-seed{seed}", lens=lens, seed=seed)
            for name in study.classifiers:
                needs = ("images", f"design/{lens}-seed{seed}", f"reference/{name}")
                add(f"fine_tune/{lens}-{name}-seed{seed}", *needs, lens=lens, measured_name=name, seed=seed)
    add("table/table1", *jobs, table="table1")
    return jobs


@pytest.fixture
def find_overwrites():
    """Function: results that a changed study overwrites if every job of the first study but `missing` is finished."""
    before = parse(base())
    write("results/tiny/study.yaml", dump(before))
    first_jobs = jobs_of(before)

    def find(after: dict, missing: tuple[str, ...] = (), only: tuple[str, ...] = ()):
        jobs = {}
        for label, job in jobs_of(parse(after)).items():
            if not only or job.rule in only:
                settings = first_jobs[label].settings if label in first_jobs else None
                jobs[label] = replace(
                    job, outputs=("file",) if label in first_jobs and label not in missing else (), made_with=settings
                )
        return find_overwritten(parse(after), jobs)

    return find


def refusal_lines(overwrites, tmp_path, cores: int = 1, ranking: bool = False) -> list[str]:
    text = refusal(overwrites, "tiny", Durations("tiny", str(tmp_path)), cores, ranking)
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
def test_a_changed_value_is_reported_in_one_line(key, value, words):
    """With its dotted key; nothing else differs, not even defaults."""
    (change,) = changes(resolve(parse(base())), resolve(parse(changed(base(), key, value))))
    assert str(change).startswith(words) and len(str(change)) < 100 and "\n" not in str(change)


def test_changes_are_those_of_the_values_alone():
    """Another order of the same values is no change; a removed value is reported with its old value."""
    study = base()
    assert changes(resolve(parse(study)), resolve(parse(dict(reversed(study.items()))))) == []
    gone = changes({"a": {"b": {"c": 1}, "d": 2}}, {"a": {"d": 2}})
    assert gone == [Change("a.b", {"c": 1}, None)] and str(gone[0]) == "a.b: removed"


def test_settings_of_another_text_need_consent(tmp_path):
    """Snakemake compares texts, and would run the network again."""
    before = changed(base(), "classifiers.small.arguments", {"in_chans": 3, "drop_rate": 0})
    after = changed(base(), "classifiers.small.arguments", {"drop_rate": 0, "in_chans": 3})
    write("results/tiny/study.yaml", dump(parse(before)))
    old = jobs_of(parse(before))
    jobs = {label: replace(job, made_with=old[label].settings) for label, job in jobs_of(parse(after)).items()}
    jobs = {label: job for label, job in jobs.items() if job.rule == "reference"}
    (_, line, *_) = refusal_lines(find_overwritten(parse(after), jobs), tmp_path)
    assert line == "  values in another order or format: 1 classifier again"


def test_a_changed_value_overwrites_what_reads_it(find_overwrites, tmp_path):
    """F/2 instead of F/2.8: both lenses and their measurements; networks of sharp images stay."""
    after = changed(base(), "spec.f_number", 2.0)
    only = ("design", "fine_tune", "table")  # Snakemake plans only these
    write(tmp_path / "benchmarks/design/a.tsv", "s\tmax_rss\n300\t1\n")
    head, line, *ways = refusal_lines(find_overwrites(after, only=only), tmp_path, cores=2)
    assert "finished results of the study tiny" in head and "nothing was changed" in head
    # two lenses of 5 minutes on two cores; each measured by the supervisor and by two other networks
    assert line == "  spec.f_number: 2.8 -> 2.0: 2 lenses, 6 classifiers again, 5 min"
    assert "--config name=tiny_2" in ways[0] and "--config overwrite=true" in ways[1]
    *_, keep, overwrite = refusal_lines(find_overwrites(after, only=only), tmp_path, ranking=True)
    assert "--name tiny_2" in keep and overwrite.endswith("--overwrite")


def test_several_changed_values_are_reported_together(find_overwrites, tmp_path):
    """The first ten changes, and the number of the others."""
    after = changed(changed(base(), "spec.f_number", 2.0), "constraints.max_track", 4.2)
    for k in range(10):
        after = changed(after, f"elements.mine{k}", ["COC"])
    lines = refusal_lines(find_overwrites(after), tmp_path)
    assert lines[11:-2] == ["  and 2 more changed values", "  together: 2 lenses, 6 classifiers again"]


def test_what_takes_long_is_not_overwritten_without_consent():
    """All jobs with checkpoints, except images, which have no inputs, and reproductions."""
    functions = {name: resolve_name(workflow().get_rule(name).params.function) for name in rule_names()}
    long = {name for name, function in functions.items() if "checkpoint" in signature(function).parameters}
    assert set(COUNTED) == long - {"images", "reproduce"}


@pytest.mark.parametrize(
    "key, value, counts",
    [
        ("fine_tuning.learning_rate", 5e-3, {"fine_tune": 6}),
        ("designs.imaging1.descents.0.steps", 9, {"design": 1, "fine_tune": 3}),
        ("classifiers.small.training.learning_rate", 2e-3, {"reference": 1, "fine_tune": 2}),
        ("images.seed", 4, {"design": 2, "reference": 3, "fine_tune": 6}),  # each set of images has searches of its own
        ("restoration.steps", 9, {}),
        ("tables", ["table1"], {}),
    ],
)
def test_only_what_depends_on_a_changed_value_is_asked_about(find_overwrites, key, value, counts):
    rules = find_overwrites(changed(base(), key, value)).by_values
    assert {rule: rules.count(rule) for rule in rules} == counts


def test_what_is_added_or_not_finished_asks_nothing(find_overwrites, tmp_path):
    """Additional seeds, lenses or classifiers; a study that never ran, and jobs of a table."""
    after = changed(changed(base(), "seeds", [0, 1]), "elements.doublet", ["COC", "OKP4"])
    after = changed(after, "classifiers.fourth", after["classifiers"]["small"])
    after = changed(after, "designs.imaging3", after["designs"]["imaging1"])
    assert find_overwrites(after).by_values == () and refusal_lines(find_overwrites(after), tmp_path) == []
    faster = changed(base(), "spec.f_number", 2.0)
    assert refusal_lines(find_overwrites(faster, missing=tuple(jobs_of(parse(base())))), tmp_path) == []
    assert refusal_lines(find_overwrites(faster, only=("table",)), tmp_path) == []


def test_a_removed_result_does_not_hide_what_is_made_of_it(find_overwrites):
    """The lens is deleted, but not the networks fine-tuned on it: changed limits would overwrite these."""
    missing = tuple(f"design/singlet-{name}-seed0" for name in LENSES)
    after = changed(base(), "constraints.max_track", 4.2)
    assert find_overwrites(after, missing=missing).by_values == 6 * ("fine_tune",)


def test_a_request_needs_no_consent(find_overwrites, tmp_path):
    """If values and code are equal, every job runs for another reason, and Snakemake knows it."""
    overwrites = find_overwrites(base())
    assert overwrites.changes == () and overwrites.by_values == () and refusal_lines(overwrites, tmp_path) == []
    assert amount(overwrites.otherwise, Durations("tiny", str(tmp_path)), 1) == "2 lenses, 9 classifiers again"


def test_changed_code_needs_consent(tmp_path):
    """Of one design, after an update: its lens and what is measured of it; with a changed value, both are named."""
    study = parse(base())
    jobs = {label: replace(job, code="new", made_by="new") for label, job in jobs_of(study).items()}
    label = "design/singlet-imaging1-seed0"
    jobs[label] = replace(jobs[label], made_by="old")
    (_, line, _, take, _) = refusal_lines(find_overwritten(study, jobs), tmp_path)
    assert line == "  changed code of TaskLens: 1 lens, 3 classifiers again"
    assert take.endswith("Or take them for results of the present code:  the same command with --touch")
    write("results/tiny/study.yaml", dump(study))
    after = parse(changed(base(), "fine_tuning.learning_rate", 5e-3))
    jobs |= {
        name: replace(job, code="new", made_by="new", made_with=jobs[name].settings)
        for name, job in jobs_of(after).items()
        if job.rule == "fine_tune"
    }
    (_, first, second, *ways) = refusal_lines(find_overwritten(after, jobs), tmp_path)
    assert not any("--touch" in way for way in ways)  # the results have other settings
    assert first.endswith("6 classifiers again") and second == "  changed code of TaskLens: 1 lens again"


def test_results_without_a_record_are_not_taken_for_others(tmp_path):
    """Results that were copied without Snakemake's folder, and a changed value."""
    study, faster = parse(base()), parse(changed(base(), "spec.f_number", 2.0))
    copied = [replace(job, remains=False, made_with=None) for job in jobs_of(faster).values()]
    assert find_unrecorded(faster, copied) is None
    write("results/tiny/study.yaml", dump(study))
    assert find_unrecorded(study, copied) is None
    assert "  spec.f_number: 2.8 -> 2.0\n" in str(find_unrecorded(faster, copied))
    longer = 2 * tiny_study()["designs"]["imaging1"]["descents"]
    for key, value, is_safe in (
        ("seeds", [0, 1], True),
        ("seeds", [1], False),
        ("designs.imaging1.descents", longer, False),
    ):
        assert (find_unrecorded(parse(changed(base(), key, value)), copied) is None) == is_safe, key
    for known in ({"made_with": "{}"}, {"outputs": ()}, {"remains": True}):
        assert find_unrecorded(faster, [replace(job, **known) for job in copied]) is None


def test_settings_of_the_outputs_count(tmp_path):
    """The lens was designed with two steps; a later run stored the study with three but left the lens alone."""
    before, after = (parse(changed(base(), "designs.imaging1.descents.0.steps", steps)) for steps in (2, 3))
    write("results/tiny/study.yaml", dump(after))
    label = "design/singlet-imaging1-seed0"
    job = replace(jobs_of(after)[label], made_with=jobs_of(before)[label].settings)
    overwrites = find_overwritten(after, {label: job})
    assert overwrites.by_values == ("design",)
    (head, line, *_) = refusal_lines(overwrites, tmp_path)
    assert "finished results" in head and line == "  entry.design.descents.0.steps: 2 -> 3: 1 lens again"
    unknown = find_overwritten(after, {label: replace(job, made_with=None)})
    assert unknown.by_values == () and unknown.otherwise == ("design",)
