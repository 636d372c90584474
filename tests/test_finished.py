"""A finished study has its files, is verified, and has a page that works in a browser."""

import json
import os
import re
from functools import partial

import browser
import pytest
import torch
from examples import read_rows
from finished_study import STUDY, TINY, content_of, design_outputs, kept, make, measured_path, values
from rules import finish, outputs
from selenium.webdriver.common.by import By

from tasklens.runtime.files import read_tensors, write_tensors
from tasklens.runtime.job import user_error
from tasklens.settings.starts import imaging_designs
from tasklens.study import table_contents
from tasklens.study.loading import parse
from tasklens.study.study import TABLES

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with the tiny study of one classifier: all tables, and every measurement reproduced."""
    folder = tmp_path_factory.mktemp("study")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        make()
        yield folder


def test_every_design_leaves_a_readable_lens(finished):
    """A prescription with its spec, origin, figures and margins, and a history."""
    for name in STUDY.designs:
        content = content_of(name)
        assert [s["medium"] for s in content["surfaces"]] == ["air", "COC", "air"]
        assert content["origin"]["design"] == name and content["spec"]["kernel_size"] == 11
        assert len(content["figures"]["rms_centroid_um"]) == 9
        assert content["worst_margin"]["value"] == min(content["margins"].values())
        assert read_rows(design_outputs(name).history)
    phases = [row["phase"] for row in read_rows(design_outputs("tasklens").history)]
    first = [f"descent 1, lens {k} of 2" for k in (1, 1, 2, 2)]
    assert phases == first + ["descent 2"] * 2 + ["descent 3", "descent 4"]


def test_design_from_imaging_begins_with_the_better_lens(finished):
    baselines = [f"singlet-{name}" for name in imaging_designs(STUDY.designs)]
    accuracies = {name: sum(values(measured_path("metrics", name), "minival_accuracy")) for name in baselines}
    start = content_of("end_to_end_from_imaging")["origin"]["start"]
    assert accuracies[start] == max(accuracies.values())


def test_psf_file_says_what_it_holds(finished):
    """3 colours, 11 x 11 pixels, and five sets of fields; the metadata's energies are the sums of the PSFs."""
    tensors, notes = read_tensors(outputs("psfs", STUDY, lens="singlet-imaging1", seed=0).psf)
    counts = {name: end - start for name, (start, end, _) in notes["sets"].items()}
    assert counts == {"training": 72, "selection": 36, "grading": 64, "nine": 9, "corner": 1}
    fields = sum(counts.values())
    assert tensors["psf"].shape == (fields, 3, 11, 11) and tensors["psf"].dtype == torch.float32
    assert len(notes["fields_mm"]) == fields and len(notes["wavelengths_um"]) == 3 and notes["pixel_pitch_um"] == 1.8
    torch.testing.assert_close(torch.tensor(notes["energy_inside"]), tensors["psf"].sum((-2, -1)))


def test_metrics_are_tidy(finished):
    """Fields of the grading, of the selection, and the corner; the images themselves have one field and no PSNR."""
    through, sharp = measured_path("metrics", "singlet-imaging1"), measured_path("metrics", "sharp")
    counts = {"accuracy": 16, "psnr_db": 16, "worst_psnr_db": 16, "minival_accuracy": 9, "corner_accuracy": 1}
    assert {metric: len(values(through, metric)) for metric in counts} == counts
    assert (values(through, "chance"), values(sharp, "psnr_db"), len(values(sharp, "accuracy"))) == ([10.0], [], 1)
    restored = measured_path("metrics", "singlet-imaging1", "small-restored")
    assert values(restored, "psnr_db") != values(through, "psnr_db")
    for path, key in ((sharp, ("", "reference", "False")), (through, ("singlet", "imaging1", "False"))):
        assert {(row["elements"], row["design"], row["restored"]) for row in read_rows(path)} == {key}
    assert {row["restored"] for row in read_rows(restored)} == {"True"}


def test_a_training_that_is_not_finite_is_a_message_too(finished):
    diverging = {"epochs": 20, "learning_rate": 10, "weight_decay": 100, "batch_size": 20}
    with pytest.raises(FloatingPointError, match=r"^fine-tune: .*lower its learning_rate$") as caught:
        finish("fine_tune", parse(TINY | {"fine_tuning": diverging}), lens="sharp", measured_name="small", seed=0)
    assert user_error(caught.value) == str(caught.value)


def test_predictions_are_kept(finished):
    """A row per test image with its label; their means are the accuracies of the metrics file."""
    rows = read_rows(measured_path("predictions", "singlet-imaging1"))
    labels = json.loads(outputs("images", STUDY).test_labels.read_text())
    assert [row["image"] for row in rows] == [str(k) for k in range(20)]
    assert [row["label"] for row in rows] == [labels["classes"][k] for k in labels["labels"]]
    means = [100 * sum(int(row[f"field{k}"]) for row in rows) / 20 for k in range(16)]
    assert means == pytest.approx(values(measured_path("metrics", "singlet-imaging1"), "accuracy"))
    assert {*rows[0]} == {"image", "label", *(f"field{k}" for k in range(16)), "corner0"}
    assert list(read_rows(measured_path("predictions", "sharp"))[0]) == ["image", "label", "field0"]


def test_a_ranking_needs_no_nine_fields(finished):
    table = list(read_rows(finish("ranking_table", STUDY).csv))
    assert len(table) == 4 and "accuracy_at_nine" not in table[0]


def test_verify_fails_for_the_limits_that_short_designs_violate_and_for_nothing_else(finished, capsys):
    """Designs of 3 steps violate limits: each violation is named, exit status 1; all measurements are reproduced.

    End-to-end design from flat plates need not converge or keep limits.
    """
    capsys.readouterr()
    with pytest.raises(SystemExit, match="1"):
        finish("verify", STUDY)
    printed = capsys.readouterr().out
    violated: dict[str, set] = {"failed": set(), "unconstrained": set()}
    for name in STUDY.designs:
        limits = [limit for limit, value in content_of(name)["margins"].items() if value < -1e-6]
        label = "unconstrained" if name == "end_to_end_from_flat" else "failed"
        violated[label] |= {f"{label}: singlet-{name} seed 0: {limit}" for limit in limits}
    converging = [line for line in printed.splitlines() if "not converged" in line]
    failure = "failed: singlet-tasklens seed 0: not converged: a step within the limits"
    assert all(line.startswith(failure) for line in converging)
    lines = [line.rpartition(": margin")[0] for line in printed.splitlines() if line not in converging]
    for label, expected in violated.items():
        assert expected and {line for line in lines if line.startswith(f"{label}: ")} == expected
    assert f"Checked 6 lenses and 11 measurements: {len(violated['failed']) + len(converging)} failures." in printed
    assert "Verdicts on the paper's claims" in printed and "fewer than five seeds" in printed


@pytest.mark.parametrize("name", ["small", "small-restored"])
def test_other_weights_do_not_reproduce(finished, capsys, name):
    """The stored head is rotated to other classes: the message counts the changed captures."""
    again = partial(finish, "reproduce", STUDY, lens="singlet-imaging1", measured_name=name, seed=0)
    path = measured_path("weights", "singlet-imaging1", name)
    weights, notes = read_tensors(path)
    weights = {key: tensor.clone() for key, tensor in weights.items()}
    turned = {key: t.roll(1, 0) if t.shape[:1] == (10,) else t for key, t in weights.items()}
    try:
        write_tensors(path, turned, notes)
        again()
        with pytest.raises(SystemExit, match="1"):
            finish("verify", STUDY)
        prefix = f"failed: singlet-imaging1 seed 0: {name}: stored predictions: "
        assert any(line.startswith(prefix) for line in capsys.readouterr().out.splitlines())
    finally:
        write_tensors(path, weights, notes)
        again()


def test_tails_of_all_lenses(finished):
    rows = read_rows(outputs("psf_tail_table", STUDY).csv)
    assert sorted(row["lens"] for row in rows) == sorted(f"singlet-{name}" for name in STUDY.designs)
    curves = read_rows(outputs("psf_tail_table", STUDY).encircled_energy)
    assert {row["lens"] for row in curves} == {row["lens"] for row in rows}
    assert all(0 <= float(row["fraction"]) <= 1 for row in curves)


@pytest.fixture(scope="module")
def page(finished):
    """The page of the study."""
    for name in STUDY.designs:
        certificate = finish("certificate", STUDY, lens=f"singlet-{name}", seed=0).page.read_text()
        assert certificate.startswith(f"# singlet-{name}, seed 0\n")
        assert all(text in certificate for text in ("## Manufacturability", "## Limits", "max slope"))
    finish("captures", STUDY)
    finish("effort_table", STUDY)
    return finished / finish("report_page", STUDY).report


def test_the_page_has_every_part(page):
    """All tables; drawings and files of every lens; names of designs are explained, below the answer and on hover."""
    text = page.read_text()
    assert [name for name in (*TABLES, "verdicts", "psf_tail", "effort") if f'<table id="{name}">' not in text] == []
    assert "Optional tables, not computed: merit function, tolerances" in text
    curves = text.count("over the distance from the axis, in units of that of the corner")
    assert curves == len(table_contents.table(STUDY, "table1").lenses)
    assert (page.parent / "answer.svg").exists() and '<table id="claims">' in text
    for name in STUDY.designs:
        assert f'download="singlet-{name}.yaml"' in text and f'download="singlet-{name}.zmx"' in text
        assert f"<dt>{name}</dt>" in text and re.search(rf'<td title="[^"]+"[^>]*>{name}</td>', text), name
    assert len(page.read_bytes()) < 15e6


def test_a_table_that_is_older_than_a_lens_says_so(page):
    """Tables of other targets are not made again with the page."""
    table = outputs("merit_function_table", STUDY).csv
    table.write_text("lens,score\nsinglet-tasklens,1.0\n")
    lens, warning = design_outputs("tasklens").lens, "Older than these lenses, so maybe of earlier ones: "
    with kept(page):
        for seconds, older in ((-1, True), (3600, False)):
            os.utime(table, times=(0, lens.stat().st_mtime + seconds))
            text = finish("report_page", STUDY).report.read_text()
            assert (warning in text) == older and '<table id="merit_function">' in text
    table.unlink()


@pytest.fixture(scope="module")
def opened(page, tmp_path_factory):
    """The page in Chromium, scrolled through once so that every chart is drawn."""
    if browser.ABSENT:
        pytest.skip(f"no {' or '.join(browser.ABSENT)}: apt-get install chromium chromium-driver")
    with browser.browser(tmp_path_factory.mktemp("profile")) as driver:
        browser.window(driver, 1280, 900)
        driver.get(page.as_uri())
        assert browser.draw_charts(driver) >= 4
        yield driver


def test_the_page_loads_nothing_and_complains_of_nothing(opened, page):
    assert opened.get_log("browser") == []
    assert browser.requests(opened, page.as_uri()) == {page.as_uri(), "data:"}
    assert not re.search(r"(src|href)=[\"'](?!data:|#)", page.read_text().partition("<script>")[0])


def test_every_picture_has_loaded_and_says_what_it_shows(opened):
    script = "return [...document.images].map(i => [i.complete && i.naturalWidth > 0, i.alt.trim()])"
    images = opened.execute_script(script)
    captures = read_rows(outputs("captures", STUDY).answers)  # of one network: a row per image
    of_lenses = len(STUDY.designs) * len(("section", "spots", "psfs", "curves"))
    by_radius = len(table_contents.table(STUDY, "table1").lenses)
    assert len(images) == 1 + len(captures) + of_lenses + by_radius >= 30
    assert all(loaded and len(words) > 10 for loaded, words in images)
    assert all(len(chart.get_attribute("aria-label")) > 40 for chart in opened.find_elements(By.CLASS_NAME, "chart"))


def test_a_table_is_sorted_by_a_click(opened):
    headings = opened.find_elements(By.CSS_SELECTOR, "#table1 th")
    column = next(k for k, head in enumerate(headings) if head.text.startswith("RMS spot"))
    values = partial(browser.numbers, opened, "table1", column)
    heading, gaps = headings[column], [value for value in values() if value is None]
    numbers = sorted(value for value in values() if value is not None)
    assert heading.get_attribute("aria-sort") == "none" and gaps and len(set(numbers)) > 2
    opened.execute_script("arguments[0].scrollIntoView({block: 'center'})", heading)
    for order in ("descending", "ascending", "descending"):
        heading.find_element(By.TAG_NAME, "button").click()
        assert heading.get_attribute("aria-sort") == order
        assert values() == (numbers if order == "ascending" else numbers[::-1]) + gaps
    assert opened.find_elements(By.CSS_SELECTOR, "#table1 th:not([aria-sort='none'])") == [heading]


def test_a_filter_hides_other_lenses(opened):
    field = opened.find_element(By.CSS_SELECTOR, "#lenses input")
    script = "return [...document.querySelectorAll('#lenses .lens')].filter(e => !e.hidden).map(e => e.dataset.name)"
    assert len(opened.execute_script(script)) == 6
    browser.write(opened, field, "singlet imaging")
    assert opened.execute_script(script) == ["singlet-imaging1", "singlet-imaging2", "singlet-end_to_end_from_imaging"]
    browser.write(opened, field, "")


def test_dark_mode_changes_page_and_charts(opened):
    (light_page, dark_text), (dark_page, light_text) = (browser.brightness(opened, s) for s in ("light", "dark"))
    assert light_page > 600 > 200 > dark_page  # of 765
    assert dark_text < 200 < 600 < light_text


@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_is_wider_than_the_screen(opened, width):
    """With all parts open; wide tables scroll in their own frames. A phone would zoom out if something were wider."""
    browser.window(opened, width, 844)
    opened.execute_script("for (const part of document.querySelectorAll('details')) part.open = true")
    assert browser.widths(opened, width) == [width, width]


@pytest.mark.parametrize("table", TABLES)
def test_tables_with_the_papers_columns_fit_a_laptop(opened, table):
    browser.window(opened, 1400, 844)
    frame = f"document.getElementById('{table}').parentElement"
    needed, available = opened.execute_script(f"return [{frame}.scrollWidth, {frame}.clientWidth]")
    assert needed <= available


@pytest.mark.parametrize("name", ["table3", "table4"])
def test_a_study_without_table_1_has_its_answer(page, name):
    """The figure is of the first table that the study has."""
    with kept(page, page.parent / "answer.svg"):
        paths = finish("report_page", STUDY.model_copy(update={"tables": (name,)}))
        assert "singlet" in paths.answer.read_text() and '<table id="claims">' in paths.report.read_text()
