"""Jobs of a study of a few seconds: their files and their errors."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from examples import changed, cooke_triplet, lens_file, measurement, read_rows, result, tiny_study, write
from rules import finish

from tasklens.cli.app import main
from tasklens.design.optimizers import AdamWOptimizer
from tasklens.optics.io import prescription
from tasklens.optics.io.prescription import Prescription
from tasklens.runtime.files import FileError, read_tensors
from tasklens.runtime.job import user_error
from tasklens.study.loading import load, parse

STUDY = parse(tiny_study())


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with the tiny study, its images and its reference classifier; stages run inside it."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "study.yaml").write_text(yaml.safe_dump(tiny_study()))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        finish("images", STUDY)
        finish("reference", STUDY, classifier="small")
        yield folder


def design(name: str) -> None:
    for rule in ("design", "psfs"):
        finish(rule, STUDY, lens=f"singlet-{name}", seed=0)


def fine_tune(lens: str, measured_name: str = "small") -> None:
    finish("fine_tune", STUDY, lens=lens, measured_name=measured_name, seed=0)


def lens_path(lens: str, name: str = "lens.yaml") -> Path:
    return lens_file("tiny", lens, name=name)


def lens_content(lens: str, seed: int = 0) -> dict:
    return yaml.safe_load(lens_file("tiny", lens, seed).read_text())


def metrics(lens: str, measured_name: str = "small") -> Path:
    return measurement("tiny", lens, measured_name)


def values(path: Path, metric: str) -> list[float]:
    return [float(row["value"]) for row in read_rows(path) if row["metric"] == metric]


@pytest.fixture(scope="module")
def lenses(workplace):
    """All six designs with their PSFs, and classifiers fine-tuned on imaging designs and on sharp images."""
    for name in ("image_error", "imaging1", "imaging2", "tasklens", "end_to_end_from_flat"):
        design(name)
    for name in ("image_error", "imaging1", "imaging2"):
        fine_tune(f"singlet-{name}")
    design("end_to_end_from_imaging")
    fine_tune("sharp")
    return workplace


@pytest.mark.parametrize(("environment", "policy"), [({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")])
def test_waiting_threads_sleep_unless_the_user_decides(environment, policy):
    """From before torch is imported, which reads it once."""
    program = "import os, sys; from tasklens.runtime.job import run_program; "
    program += "run_program(lambda: print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules), None)"
    done = subprocess.run([sys.executable, "-c", program], env=os.environ | environment, capture_output=True, text=True)
    assert done.stdout.split() == [policy, "False"]


def test_a_program_ends_with_its_status_and_all_that_it_printed(workplace):
    """It frees no memory at exit, but its output to a pipe is complete."""
    program = [sys.executable, "-m", "tasklens.cli"]
    done = subprocess.run(
        [*program, "study", "check", "--no-weight-files", "study.yaml"], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (0, "tiny: 6 lenses, 2 classifiers, seeds [0]\n")
    done = subprocess.run([*program, "study", "check", "absent.yaml"], capture_output=True, text=True)
    assert done.returncode == 2 and "absent.yaml" in done.stderr


def test_every_design_leaves_a_readable_lens(lenses):
    """A prescription with its spec, origin, figures and margins, and a history of finite numbers."""
    for name in tiny_study()["designs"]:
        content = lens_content(f"singlet-{name}")
        assert [s["medium"] for s in content["surfaces"]] == ["air", "COC", "air"]
        assert content["origin"]["design"] == name and content["spec"]["kernel_size"] == 11
        assert len(content["figures"]["rms_centroid_um"]) == 9
        assert content["worst_margin"]["value"] == min(content["margins"].values())
        assert read_rows(lens_path(f"singlet-{name}", "history.csv"))
    phases = [row["phase"] for row in read_rows(lens_path("singlet-tasklens", "history.csv"))]
    first = [f"descent 1, lens {k} of 2" for k in (1, 1, 2, 2)]
    assert phases == first + ["descent 2"] * 2 + ["descent 3", "descent 4"]


def test_a_design_that_diverges_says_so_in_its_lens_file(workplace, monkeypatch):
    """If the gradient is not finite at the third step, the lens of the second step is written."""
    change, steps = AdamWOptimizer.change, iter((1.0, 1.0, float("nan")))
    monkeypatch.setattr(AdamWOptimizer, "change", lambda *rest: next(steps) * change(*rest))
    finish("design", STUDY, lens="singlet-imaging1", seed=9)
    assert lens_content("singlet-imaging1", 9)["origin"]["diverged"].startswith("step 3: ")


def test_design_from_imaging_begins_with_the_better_lens(lenses):
    baselines = [f"singlet-{name}" for name in ("image_error", "imaging1", "imaging2")]
    accuracies = {name: sum(values(metrics(name), "minival_accuracy")) for name in baselines}
    start = lens_content("singlet-end_to_end_from_imaging")["origin"]["start"]
    assert accuracies[start] == max(accuracies.values())


def test_psf_file_says_what_it_holds(lenses):
    """3 colours, 11 x 11 pixels, and five sets of fields; the metadata's energies are the sums of the PSFs."""
    tensors, notes = read_tensors(lens_path("singlet-imaging1", "psf.safetensors"))
    counts = {name: end - start for name, (start, end, _) in notes["sets"].items()}
    assert counts == {"training": 72, "selection": 36, "grading": 64, "nine": 9, "corner": 1}
    fields = sum(counts.values())
    assert tensors["psf"].shape == (fields, 3, 11, 11) and tensors["psf"].dtype == torch.float32
    assert len(notes["fields_mm"]) == fields and len(notes["wavelengths_um"]) == 3 and notes["pixel_pitch_um"] == 1.8
    torch.testing.assert_close(torch.tensor(notes["energy_inside"]), tensors["psf"].sum((-2, -1)))


def test_metrics_are_tidy(lenses):
    """Fields of the grading, of the selection, and the corner; the images themselves have one field and no PSNR."""
    through = metrics("singlet-imaging1")
    counts = {"accuracy": 16, "psnr_db": 16, "worst_psnr_db": 16, "minival_accuracy": 9, "corner_accuracy": 1}
    assert {metric: len(values(through, metric)) for metric in counts} == counts
    assert values(through, "chance") == [10.0]
    sharp = metrics("sharp")
    assert len(values(sharp, "accuracy")) == 1 and values(sharp, "psnr_db") == []
    assert {(row["elements"], row["design"]) for row in read_rows(sharp)} == {("", "reference")}
    assert {(row["elements"], row["design"], row["restored"]) for row in read_rows(through)} == {
        ("singlet", "imaging1", "False")
    }


def test_restoration_and_drawings(lenses):
    """Restored captures have their own metrics; drawings and the certificate are written."""
    finish("restore", STUDY, lens="singlet-imaging1", seed=0)
    fine_tune("singlet-imaging1", "small-restored")
    restored = metrics("singlet-imaging1", "small-restored")
    assert values(restored, "psnr_db") != values(metrics("singlet-imaging1"), "psnr_db")
    assert {row["restored"] for row in read_rows(restored)} == {"True"}
    drawn = finish("drawing", STUDY, lens="singlet-imaging1", seed=0)
    assert drawn.figure.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    page = finish("certificate", STUDY, lens="singlet-imaging1", seed=0).page.read_text()
    assert page.startswith("# singlet-imaging1, seed 0\n") and "## Manufacturability" in page


@pytest.mark.slow
def test_an_imported_lens_goes_the_same_way(tmp_path, monkeypatch, capsys):
    """From its file to its PSF and figure; `check` reports unusable lenses before any job."""
    monkeypatch.chdir(tmp_path)
    prescription.write(tmp_path / "theirs.yaml", Prescription(cooke_triplet()), {})
    entry = {"elements": "triplet", "file": "theirs.yaml", "focus": "spot"}
    study = changed(tiny_study(), "imported.cooke", entry)
    path = tmp_path / "imported.yaml"
    path.write_text(yaml.safe_dump(changed(study, "spec.field_of_view_deg", 36)))
    for rule in ("design", "psfs", "certificate", "drawing"):
        finish(rule, load(path), lens="triplet-cooke", seed=0)
    content = lens_content("triplet-cooke")
    assert content["origin"]["file"] == "theirs.yaml" and content["stop"] == 4
    assert content["figures"]["efl_mm"] == pytest.approx(content["spec"]["efl_mm"], rel=1e-12)
    assert result("tiny", "figures/triplet-cooke-seed0.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert main(["study", "check", "--no-weight-files", "imported.yaml"]) == 0
    path.write_text(yaml.safe_dump(changed(study, "spec.field_of_view_deg", 120)))
    assert main(["study", "check", "--no-weight-files", "imported.yaml"]) == 2
    assert "theirs.yaml: does not cover the field" in capsys.readouterr().err


def test_analyse_prints_the_table_of_a_lens_file(lenses, capsys):
    """From the prescription and the spec in the file, without a study: the numbers that the design wrote."""
    content = lens_content("singlet-imaging1")
    capsys.readouterr()
    assert main(["lens", "analyse", str(lens_path("singlet-imaging1")), "--rays", "64"]) == 0
    printed = capsys.readouterr().out
    assert f"{content['figures']['efl_mm']:.4f}" in printed and content["worst_margin"]["limit"] in printed
    assert all(f" {value:.2f} |" in printed for value in content["figures"]["rms_centroid_um"])


def test_analyse_needs_a_field_and_a_number_of_rays(lenses, capsys):
    content = lens_content("singlet-imaging1")
    (lenses / "bare.yaml").write_text(yaml.safe_dump({k: v for k, v in content.items() if k != "spec"}))
    assert main(["lens", "analyse", "bare.yaml"]) == 2
    assert capsys.readouterr().err.startswith("tasklens: bare.yaml: has neither a spec nor fields; give")
    for wrong in ("0", "-3", "many"):
        assert main(["lens", "analyse", "bare.yaml", "--rays", wrong]) == 2


def test_a_training_that_is_not_finite_is_a_message_too(workplace):
    study = changed(
        tiny_study(), "fine_tuning", {"epochs": 20, "learning_rate": 10, "weight_decay": 100, "batch_size": 20}
    )
    with pytest.raises(FloatingPointError, match=r"^fine-tune: .*lower its learning_rate$") as caught:
        finish("fine_tune", parse(study), lens="sharp", measured_name="small", seed=0)
    assert user_error(caught.value) == str(caught.value)


def test_a_broken_lens_file_is_a_message_too(workplace):
    for name in ("lens.yaml", "psf.safetensors"):
        write(lens_file("tiny", "singlet-imaging1", 5, name), "format: 2\n")
    with pytest.raises(FileError, match=r"seed5/lens\.yaml: "):
        finish("certificate", STUDY, lens="singlet-imaging1", seed=5)
