"""Tables from metrics and lens files with known numbers."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pandas
import pytest
import yaml
from examples import write
from studies import changed, lens_file, measurements_of, result, tiny_study
from study_results import write_measurement

from tasklens.settings.names import SHARP, measured_name
from tasklens.show import headings
from tasklens.study.loading import dump, parse
from tasklens.study.report import tables
from tasklens.study.report.measurements import has_failed
from tasklens.study.study import TABLES
from tasklens.study.table_contents import table as table_of

PAPER_VALUES = Path(tables.__file__).with_name("paper.csv")
FIELDS, CHANCE, REFERENCE = 9, 10.0, 90.0
ACCURACY = {
    "doublet-tasklens": 70.0,
    "doublet-image_error": 62.0,
    "doublet-imaging1": 60.0,
    "doublet-imaging2": 65.0,
    "doublet-end_to_end_from_imaging": 60.0,
    "doublet-end_to_end_from_flat": 40.0,  # less than half-way from chance to reference
    "quadruplet-phone_4p": 80.0,  # only in a study that imports it
}
PAPER = pandas.DataFrame(
    [
        ("table1", "", "reference", "resnet", "accuracy", 75.63),
        ("table1", "doublet", "tasklens", "resnet", "accuracy", 70.08),
        ("table1", "doublet", "tasklens", "resnet", "psnr_db", 19.46),
        ("table2", "doublet", "tasklens", "small", "accuracy", 70.0),
        ("table3", "doublet", "tasklens", "resnet", "accuracy", 70.05),
        ("table3", "doublet", "end_to_end_from_flat", "resnet", "failed", 1.0),
        ("table4", "doublet", "tasklens", "resnet", "psnr_db", 24.0),
    ],
    columns=["table", "elements", "design", "classifier", "metric", "value"],
)


@pytest.fixture(scope="module")
def study():
    tiny = changed(tiny_study(), "designs.tasklens.descents", tiny_study()["designs"]["tasklens"]["descents"][:-1])
    return parse(changed(changed(tiny, "elements", {"doublet": ["COC", "OKP4"]}), "seeds", [0, 1]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, study):
    """Files of two seeds, the second 2 % points better, fields of one lens spread about their mean."""
    folder = tmp_path_factory.mktemp("tables")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_results(study)
    return folder


@pytest.fixture(autouse=True)
def results(folder, monkeypatch):
    monkeypatch.chdir(folder)


def write_results(study) -> None:
    spread = [k - (FIELDS - 1) / 2 for k in range(FIELDS)]

    def measure(lens, name, seed, accuracy, psnr):
        metrics = {"accuracy": [accuracy + s for s in spread], "minival_accuracy": [2.0 - seed] * FIELDS}
        metrics |= {"chance": CHANCE, "parameters_m": 0.5}
        if psnr:
            metrics |= {"psnr_db": [psnr + s for s in spread], "worst_psnr_db": [psnr - 8 + s for s in spread]}
        write_measurement("tiny", lens, name, seed, metrics, frozen=[[(100 - accuracy) / 100] * FIELDS] * 4)

    for seed in study.seeds:
        for classifier in study.classifiers:
            measure(SHARP, classifier, seed, REFERENCE, None)
            for lens, accuracy in ACCURACY.items():
                measure(lens, classifier, seed, accuracy + 2 * seed, 20.0)
                measure(lens, measured_name(classifier, True), seed, accuracy + 5 + 2 * seed, 25.0)
        for lens in ACCURACY:
            inside = 0.3 if lens == "doublet-end_to_end_from_imaging" and seed == 1 else 0.9
            means = {"rms_spot_um": 12.0, "core_radius_um": 3.0, "energy_in_window": inside}
            margin = {"limit": "max_slope", "value": 0.01 - 0.03 * seed}
            content = yaml.safe_dump({"means": means, "worst_margin": margin})
            write(lens_file("tiny", lens, seed), content)


def table(study, name):
    """A table from the files of its job, indexed by design."""
    contents = table_of(study, name)
    rows = tables.collect(contents, measurements_of("tiny", contents))
    return tables.summarise(contents, rows, PAPER).set_index("design")


def test_table1_means_over_fields_and_seeds(study):
    """All lenses and the reference: means of 9 fields and 2 seeds, the spread of seeds, the paper's values."""
    frame = table(study, "table1")
    assert list(frame.index) == ["reference", "tasklens", "image_error", "imaging1", "imaging2"]
    assert frame.loc["reference", "accuracy"] == pytest.approx(90)
    row = frame.loc["tasklens"]
    assert row["accuracy"] == pytest.approx(71) and row["accuracy_std"] == pytest.approx(2**0.5)
    assert row["accuracy_median"] == pytest.approx(71)
    assert row["accuracy_best_minival"] == pytest.approx(70)
    assert row["psnr_db"] == pytest.approx(20) and row["psnr_db_std"] == pytest.approx(0, abs=1e-12)
    assert row["rms_spot_um"] == pytest.approx(12) and row["core_radius_um"] == pytest.approx(3)
    assert row["energy_in_window"] == pytest.approx(0.9)
    assert row["worst_margin"] == pytest.approx(-0.02) and "worst_margin_std" not in frame  # the worst of both seeds
    assert row["frozen_loss"] == pytest.approx(0.29) and frame.loc["reference", "frozen_loss"] == pytest.approx(0.1)
    assert row["gap"] == pytest.approx(-0.05)  # below imaging2, 0.05 better
    assert pandas.isna(frame.loc["imaging2", "gap"])  # saw no image
    assert frame.loc["image_error", "gap"] > 0
    assert row["accuracy_paper"] == 70.08 and row["psnr_db_paper"] == 19.46
    assert frame.loc["reference", "accuracy_paper"] == 75.63
    assert pandas.isna(frame.loc["imaging1", "accuracy_paper"])


def test_table2_has_a_row_per_lens_and_classifier(study):
    frame = table(study, "table2").reset_index()
    assert len(frame) == 4 * 2
    row = frame[(frame.design == "tasklens") & (frame.classifier == "small")].iloc[0]
    assert row["accuracy"] == pytest.approx(71) and row["reference_accuracy"] == pytest.approx(90)
    assert row["parameters_m"] == pytest.approx(0.5) and row["accuracy_paper"] == 70.0


def test_table3_counts_failures_by_its_rule(study):
    """Half of the light in the window and half of the reference above chance; a seed that lacks one has failed."""
    frame = table(study, "table3")
    assert frame["failed"].to_dict() == {"tasklens": 0, "end_to_end_from_imaging": 0.5, "end_to_end_from_flat": 1}
    text = headings.texts(frame.reset_index()).set_index("design")
    assert text.loc["tasklens", "failed [%]"] == "0" and text.loc["end_to_end_from_flat", "failed [%]"] == "100"
    assert text.loc["end_to_end_from_flat", "failed [%], paper"] == "100"


@pytest.mark.parametrize("accuracy, inside, expected", [(50, 0.5, False), (49.9, 1, True), (90, 0.49, True)])
def test_failure_rule(accuracy, inside, expected):
    """Chance 10 %, reference 90 %: 50 % is half-way."""
    assert has_failed(accuracy, REFERENCE, CHANCE, inside) is expected


def test_table4_is_about_restored_captures(study):
    row = table(study, "table4").loc["tasklens"]
    assert row["accuracy"] == pytest.approx(76) and row["psnr_db"] == pytest.approx(25)
    assert row["psnr_db_paper"] == 24.0 and row["worst_psnr_db"] == pytest.approx(17)


def test_an_imported_lens_has_its_rows(study, tmp_path):
    """The lens is the last row of tables 1, 2 and 4, without a value of the paper."""
    (tmp_path / "phone.yaml").write_text("")
    entry = {"phone_4p": {"elements": "quadruplet", "file": str(tmp_path / "phone.yaml")}}
    study = parse(yaml.safe_load(dump(study)) | {"imported": entry})
    for name, accuracy in (("table1", 81), ("table2", 81), ("table4", 86)):
        frame = table(study, name)
        rows = frame[frame.elements == "quadruplet"]
        assert len(rows) == (2 if name == "table2" else 1) and frame.index[-1] == "phone_4p"
        assert rows["accuracy"].tolist() == pytest.approx([accuracy] * len(rows))
        assert rows["accuracy_paper"].isna().all() if "accuracy_paper" in rows else name == "table4"
    assert "quadruplet" not in set(table(study, "table3").elements)


def test_one_seed_has_no_spread(study):
    frame = table(study.model_copy(update={"seeds": (0,)}), "table1")
    assert not [name for name in frame.columns if name.endswith("_std")]
    assert frame.loc["tasklens", "accuracy"] == pytest.approx(70)


def make(contents) -> SimpleNamespace:
    """The files of a table."""
    files = measurements_of("tiny", contents)
    suffixes = {"csv": "csv", "md": "md", "tex": "tex", "seeds_csv": "seeds.csv", "json": "json"}
    outputs = {name: result("tiny", f"tables/{contents.name}.{suffix}") for name, suffix in suffixes.items()}
    inputs = ([*paths.values()] for paths in (files.lenses, files.metrics, files.frozen))
    tables.make(contents, *inputs, **outputs)
    return SimpleNamespace(**outputs)


@pytest.mark.parametrize("name", TABLES)
def test_files_of_a_table_agree(study, name):
    """CSV, Markdown and LaTeX have the same rows; the sidecar file records their provenance."""
    outputs = make(table_of(study, name))
    rows = pandas.read_csv(outputs.csv, keep_default_na=False)
    body = [line for line in outputs.md.read_text().splitlines() if line.startswith("|")][2:]
    assert len(body) == len(rows) == {"table1": 5, "table2": 8, "table3": 3, "table4": 4}[name]
    designs = [design.replace("reference", "no lens") for design in rows["design"]]  # of sharp images
    assert all(design in line for design, line in zip(designs, body, strict=True))
    by_seed = pandas.read_csv(outputs.seeds_csv, keep_default_na=False)
    assert len(by_seed) == 2 * len(rows) and by_seed["seed"].tolist() == [0] * len(rows) + [1] * len(rows)
    assert by_seed["accuracy"].astype(float).mean() == pytest.approx(rows["accuracy"].mean())
    alignment, body = latex_body(outputs.tex)
    assert [line.split(" & ")[1] for line in body] == [design.replace("_", r"\_") for design in designs]
    assert {line.count(" & ") + 1 for line in body} == {len(alignment)}
    assert "nan" not in outputs.tex.read_text().lower()
    notes = json.loads(outputs.json.read_text())
    assert notes["study"] == "tiny" and notes["seeds"] == [0, 1] and set(notes["versions"]) == set(tables.PACKAGES)


def latex_body(path: Path) -> tuple[str, list[str]]:
    """Alignment of the columns of a LaTeX table, and its rows without the heading."""
    match = re.search(r"begin{tabular}{([lr]+)}.*\\midrule\n(.*) \\\\\n\\bottomrule", path.read_text(), re.DOTALL)
    assert match is not None
    return match[1], match[2].split(" \\\\\n")


def test_latex_can_be_pasted(study):
    """Words and units as headings, mean and spread in one cell, the best value bold, the paper's columns labelled."""
    outputs = make(table_of(study, "table3").model_copy(update={"study": "my_study"}))
    latex, (alignment, body) = outputs.tex.read_text(), latex_body(outputs.tex)
    assert latex.startswith(r"% Needs \usepackage{booktabs}.") and r"\label{tab:my-study-table3}" in latex
    assert r"my\_study" in latex and not re.search(r"(?<!\\)_", latex)
    assert alignment == "ll" + "r" * (len(alignment) - 2) and latex.count("{") == latex.count("}")
    header = next(line for line in latex.splitlines() if line.startswith("elements"))
    assert header.startswith(r"elements & design & accuracy [\%] & ")
    assert header.endswith(r" & accuracy [\%], paper & failed [\%], paper \\")
    assert body[0].startswith(r"doublet & tasklens & \textbf{71.0 ± 1.4} & ")
    assert body[2].startswith(r"doublet & end\_to\_end\_from\_flat & 41.0 ± 1.4 & ") and "-0.020" in body[2]
    assert "Mean ± standard deviation over seeds. Bold: the best of the same elements." in latex


def test_the_papers_values_are_those_of_its_tables():
    """Every lens of table 1 has an accuracy; the doublet TaskLens reads 70.08 % in table 1 and 70.05 % in table 3."""
    paper = pandas.read_csv(PAPER_VALUES, keep_default_na=False)
    assert not paper.duplicated(["table", "elements", "design", "classifier", "metric"]).any()
    assert set(paper["table"]) == set(TABLES)
    index = paper.set_index(["table", "elements", "design", "classifier", "metric"])["value"].astype(float)
    assert index["table1", "doublet", "tasklens", "resnet", "accuracy"] == 70.08
    assert index["table3", "doublet", "tasklens", "resnet", "accuracy"] == 70.05
    assert index["table1", "", "reference", "resnet", "accuracy"] == 75.63
