"""Imported lenses: what the fit to a specification keeps, changes and refuses."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from designs import tiny_network
from examples import cooke_triplet, make_lens, random_images
from reference_files import reference_files
from studies import changed, tiny_study, with_imported

from tasklens.design import methods
from tasklens.design.criteria import TaskLoss
from tasklens.design.objective import Objective
from tasklens.design.problem import Problem
from tasklens.optics.analysis.focus import move_image_plane, refocus
from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.optics.analysis.spots import centroid, evaluation_psf, rms_spot_radius, trace_fields, trace_fields_full
from tasklens.optics.io import imported, prescription, zemax
from tasklens.optics.io.prescription import Prescription
from tasklens.optics.lens import Lens
from tasklens.optics.view import view_of_spec
from tasklens.recognition.training import fit as fit_network
from tasklens.runtime.files import FileError
from tasklens.settings.lens_entries import ImportedLens
from tasklens.settings.network_settings import TrainingSettings
from tasklens.settings.specification import Spec
from tasklens.study.loading import parse
from tasklens.study.study import StudyError
from tasklens.study.table_contents import lens_design

SPEC = Spec(field_of_view_deg=36, f_number=4, kernel_size=101)
VIEW = view_of_spec(SPEC)
VIEW_31 = replace(VIEW, kernel_size=31)
RAYS = 512


def fit_lens(folder: Path, lens: Lens, spec: Spec = SPEC, **use) -> tuple[Lens, dict]:
    prescription.write(folder / "given.yaml", Prescription(lens, **use), {})
    return imported.fit(ImportedLens(elements="triplet", file=folder / "given.yaml"), view_of_spec(spec), spec.f_number)


def test_size_and_stop_of_the_file_do_not_matter(tmp_path):
    """A file of the same lens 7 times as large, stopped down and out of focus: it is as much out of focus as before."""
    expected, notes = fit_lens(tmp_path, cooke_triplet())
    large = cooke_triplet().scaled(7.0).with_stop_scaled(0.4)
    large.thickness[-1] += 1.5
    refitted, large_notes = fit_lens(tmp_path, large, object_distance_mm=800.0)
    for name in ("curvature", "conic", "alpha", "semi_diameter"):
        torch.testing.assert_close(getattr(refitted, name), getattr(expected, name), rtol=1e-12, atol=0)
    moved = move_image_plane(expected, 1.5 * large_notes["scale"]).thickness
    torch.testing.assert_close(refitted.thickness, moved, rtol=0, atol=1e-6)
    assert (refitted.media, refitted.stop) == (expected.media, expected.stop)
    assert large_notes["scale"] == pytest.approx(notes["scale"] / 7, rel=1e-12)
    assert large_notes["file_efl_mm"] == pytest.approx(7 * notes["file_efl_mm"], rel=1e-12)
    assert (notes["file_object_distance_mm"], large_notes["file_object_distance_mm"]) == (None, 800.0)


def test_the_image_plane_is_where_the_mean_spot_is_smallest(tmp_path):
    """Tracing through to planes on both sides, near and far, gives larger means; single fields differ."""
    lens = refocus(fit_lens(tmp_path, cooke_triplet())[0], VIEW, "spot")

    def rms(shift: float) -> torch.Tensor:
        rays = trace_fields(move_image_plane(lens, shift), VIEW, sobol_disc(RAYS, 0))
        return rms_spot_radius(rays, centroid(rays))

    best = float(rms(0.0).mean())
    for shift in (1e-4, 1e-3, 0.1):
        assert float(rms(shift).mean()) > best < float(rms(-shift).mean())
    slopes = (rms(1e-3) - rms(-1e-3)).sign()
    assert {-1.0, 1.0} <= set(slopes.tolist())


# ---- notes of a finished lens


def settings_of(folder: Path, lens: Lens, focus: str | None = "file", **spec):
    """Settings of the design of a lens in a file, as a study declares them."""
    prescription.write(folder / "given.yaml", Prescription(lens), {})
    entry = {"elements": "triplet", "file": str(folder / "given.yaml"), "focus": focus}
    study = changed(
        changed(tiny_study(), "imported.cooke", entry),
        "spec",
        {"kernel_size": 11, "field_of_view_deg": 36, "f_number": 4} | spec,
    )
    return lens_design(parse(changed(study, "evaluation_rays", RAYS)), "triplet-cooke", 0)


def test_a_finished_imported_lens(tmp_path):
    """It has an origin, figures, margins, and finite clear apertures that stop no further rays."""
    settings = settings_of(tmp_path, cooke_triplet())
    lens, notes, history, _ = methods.design(settings, None, None, {}, {})
    assert history == []
    before, fit = imported.fit(settings.entry.design, VIEW, SPEC.f_number)
    assert notes["origin"] == {"design": "cooke", "method": "file"} | fit | {"image_plane_shift_mm": 0.0}
    assert fit["file"] == str(tmp_path / "given.yaml")
    assert len(notes["margins"]) == 9 and lens.semi_diameter.isfinite().all()
    assert torch.equal(lens.thickness, before.thickness)
    valid = [trace_fields(candidate, VIEW, sobol_disc(RAYS, 0)).valid for candidate in (before, lens)]
    assert torch.equal(*valid)


def test_the_network_sets_the_focus_of_a_scaled_lens(tmp_path, few_rays):
    """Its loss on training images is no larger than at the peak of the MTF; in the plane of the file it is larger."""
    images, network = random_images(12, 16, 3, seed=0), tiny_network()
    fit_network(network, images, TrainingSettings(epochs=60, learning_rate=1e-2, batch_size=12), 0, "sharp")
    settings = settings_of(tmp_path, move_image_plane(cooke_triplet(), 1.5), focus=None, kernel_size=31)
    lens, notes, *_ = methods.design(settings, network, images, {}, {})
    problem = Problem(VIEW_31, settings.constraints, settings.seed, settings.capture, images)
    objective = Objective(TaskLoss(network), problem, None, False, 36, "chief_ray")
    given = fit_lens(tmp_path, move_image_plane(cooke_triplet(), 1.5))[0]
    own, peak, file = (
        float(objective.fixed_losses(each, 1.0, slice(24)).mean()) for each in (lens, refocus(given, VIEW_31), given)
    )
    assert own <= peak < file
    assert notes["origin"]["focus"] == "network"
    assert notes["origin"]["image_plane_shift_mm"] == pytest.approx(float(lens.thickness[-1] - given.thickness[-1]))


@pytest.mark.parametrize("focus, plane", [("file", 0.01), ("mtf", 0.0), ("spot", 0.0)])
def test_the_image_plane_of_the_file_remains_unless_another_is_asked_for(tmp_path, focus, plane):
    """A lens in its own size, 10 um out of focus; it needs no network."""
    lens = move_image_plane(
        refocus(fit_lens(tmp_path, cooke_triplet())[0], VIEW_31, "spot" if focus == "spot" else "mtf"), 0.01
    )
    settings = settings_of(tmp_path, lens, focus=focus, kernel_size=31)
    result, notes, *_ = methods.design(settings, None, None, {}, {})
    assert float(result.thickness[-1] - lens.thickness[-1]) == pytest.approx(plane - 0.01, abs=1e-4)
    assert notes["origin"]["focus"] == focus


def test_a_lens_in_its_own_size_keeps_its_image_plane(tmp_path):
    """Without `focus`; at another object distance, or scaled, the network sets it."""
    given = fit_lens(tmp_path, cooke_triplet())[0]
    assert fit_lens(tmp_path, given)[1]["focus"] == "file"
    assert fit_lens(tmp_path, given, object_distance_mm=100.0)[1]["focus"] == "network"
    assert fit_lens(tmp_path, given.scaled(1.01))[1]["focus"] == "network"


def test_its_own_clear_apertures_vignette(tmp_path):
    """They scale with the lens; a PSF covers only the light that passes."""
    bare = fit_lens(tmp_path, cooke_triplet())[0]
    triplet = cooke_triplet()
    triplet.semi_diameter[0] = 8.0
    settings = settings_of(tmp_path, triplet, kernel_size=31)
    lens, notes, *_ = methods.design(settings, None, None, {}, {})
    scale = notes["origin"]["scale"]
    assert float(lens.semi_diameter[0]) == pytest.approx(8.0 * scale, rel=1e-14)
    everything, record = trace_fields_full(bare, VIEW, sobol_disc(RAYS, 0))
    passes = torch.hypot(record[0].x, record[0].y) <= 8.0 * scale
    valid = trace_fields(lens, VIEW, sobol_disc(RAYS, 0)).valid
    assert torch.equal(valid, everything.valid & passes)
    shares = notes["figures"]["valid_fraction"]
    assert shares == pytest.approx(valid.double().mean((1, 2)).tolist()) and shares[-1] < 0.9 < shares[0]
    energy = evaluation_psf(lens, view_of_spec(settings.spec), RAYS).sum((-2, -1))
    torch.testing.assert_close(energy, torch.ones_like(energy), rtol=0, atol=1e-12)
    assert notes["figures"]["energy_in_window"] == pytest.approx([1.0] * 9, abs=1e-12)
    again = imported.read(settings.entry.design)[0].lens
    assert float(again.semi_diameter[0]) == 8.0  # the file's lens is not changed


def test_a_zemax_file_and_our_own_give_the_same_lens(tmp_path):
    options = {"fields": ("angle_deg", ((0.0, 0.0),)), "wavelengths_um": (0.5893,), "primary": 0}
    options |= {"object_distance_mm": 500.0}
    expected, notes = fit_lens(tmp_path, cooke_triplet(), **options)
    zemax.write(tmp_path / "lens.ZMX", Prescription(cooke_triplet(), **options))
    zemax_lens, zemax_notes = imported.fit(ImportedLens(elements="x", file=tmp_path / "lens.ZMX"), VIEW, SPEC.f_number)
    assert torch.equal(zemax_lens.thickness, expected.thickness) and zemax_lens.media == expected.media
    assert notes | {"file": ""} == zemax_notes | {"file": ""}


# ---- errors


DIVERGING = make_lens([0.0, -0.05, 0.0], [1.0, 1.0, 9.0], ("air", "COC", "air"))


def narrow_front() -> Lens:
    lens = cooke_triplet()
    lens.semi_diameter[0] = 3.3
    return lens


@pytest.mark.parametrize(
    "lens, spec, words",
    [
        (DIVERGING, {}, ["focal length -", "expected a positive one"]),
        (cooke_triplet(curvature=torch.zeros(9, dtype=torch.float64)), {}, ["focal length", "expected a positive one"]),
        (narrow_front(), {}, ["F/4", "axis", "clear aperture of surface 0"]),
        (narrow_front(), {"f_number": 8}, ["does not cover", "degrees", "clear aperture of surface 0"]),
        (cooke_triplet(), {"field_of_view_deg": 110}, ["does not cover", "degrees", "surface"]),
        (cooke_triplet(), {"wavelengths_um": (2.4, 0.6, 0.5)}, ["2.4 um", "1.62041/60.3", "0.38 to 0.78"]),
    ],
)
def test_a_lens_that_cannot_serve_the_specification_is_refused(tmp_path, lens, spec, words):
    with pytest.raises(FileError) as error:
        fit_lens(tmp_path, lens, Spec(**{"field_of_view_deg": 36, "f_number": 4} | spec))
    assert all(word in str(error.value) for word in ["given.yaml", *words]), error.value


# ---- published lenses

PHONES = [path for path in reference_files("lenses/cellphone/source/*") if path.suffix.lower() == ".zmx"]


def test_the_catalogues_of_a_zemax_file_are_its_sources(tmp_path):
    """The file may name those beside it and the built-in ones; a job whose catalogue changes runs again."""
    for name in ("mine.zmx", "mine.agf", "other.agf"):
        (tmp_path / name).touch()
    other = tmp_path / "other.agf"
    lens = ImportedLens(elements="phone", file=tmp_path / "mine.zmx", catalogues=(other,))
    assert lens.sources[:3] == (tmp_path / "mine.zmx", other, tmp_path / "mine.agf")
    assert {path.name for path in lens.sources[3:]} > {"plastics.yaml", "SCHOTT.agf"}


def phone(path: Path) -> ImportedLens:
    return ImportedLens(elements="phone", file=path, catalogues=tuple(reference_files("glass/*.AGF")))


@pytest.mark.parametrize("path", PHONES, ids=lambda path: path.stem)
def test_every_phone_lens_serves(path):
    """Three to eight elements, stops in front and inside: focal length, F-number, and an image of 8 um or better.

    The stop is filled.

    If the stop is inside, a few percent of the rays are lost behind it by total reflection at the largest fields.
    """
    spec = Spec()
    lens = refocus(imported.fit(phone(path), view_of_spec(spec), spec.f_number)[0], view_of_spec(spec), "spot")
    first_order = paraxial(lens, spec.wavelengths_um[1])
    assert float(first_order.efl) == pytest.approx(spec.efl_mm, rel=1e-9)
    assert float(first_order.f_number) == pytest.approx(2.8, rel=1e-9)
    rays = trace_fields(lens, view_of_spec(spec), sobol_disc(256, 0))
    assert float(rms_spot_radius(rays, centroid(rays)).max()) < 8e-3
    assert float(rays.valid.double().mean((1, 2)).min()) > (0.9 if lens.stop > 1 else 1 - 1e-12)
    assert rays.valid[0].all() and (rays.lost_at[~rays.valid] > lens.stop).all()


def test_an_imported_lens_has_a_specification_of_its_own():
    """Other lenses keep the study's, and a wrong key is named; only imported lenses may have a near object."""
    study = parse(changed(with_imported(), "imported.phone.spec", {"f_number": 2.0}))
    assert study.lens_spec("quadruplet-phone").f_number == 2.0
    assert study.lens_spec("singlet-imaging1") == study.spec_of("singlet")
    with pytest.raises(StudyError, match=r"imported\.phone\.spec\.f_numbr = 2\.0: unknown key"):
        parse(changed(with_imported(), "imported.phone.spec", {"f_numbr": 2.0}))
    with pytest.raises(StudyError, match=r"spec\.object_distance_mm: designs need an object at infinity"):
        parse(changed(with_imported(), "spec.object_distance_mm", 100))


def test_a_design_starts_from_a_lens_of_its_own_specification():
    """Its F-number would be that of the start; the PSF window of the start does not matter."""
    study = changed(with_imported(), "imported.phone.elements", "singlet")
    study = changed(study, "designs.image_error.start", ["phone"])
    same = {"kernel_size": 13, "f_number": parse(tiny_study()).spec.f_number}
    assert parse(changed(study, "imported.phone.spec", same))
    words = r"designs\.image_error\.start: imported\.phone\.spec has another f_number than the design"
    with pytest.raises(StudyError, match=words):
        parse(changed(study, "imported.phone.spec", {"f_number": 2.0}))
