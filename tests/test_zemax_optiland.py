"""Optiland, another ray tracer, reads the Zemax files that we write, except for surfaces that it lacks."""

import math

import pytest
from examples import f64, make_lens
from reference_files import ZEMAX_FILES, read_zemax

from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.io import zemax
from tasklens.optics.io.prescription import Prescription, with_system_data
from tasklens.optics.view import view_of_spec
from tasklens.settings.specification import Spec

optiland = pytest.importorskip("optiland.fileio")
LENS = make_lens(  # a doublet that fits the default specification to first order
    [0.0, 0.5, -0.3, 0.1, 0.2],
    [0.1, 0.9, 0.4, 0.7, 2.0],
    ("air", "COC", "air", "PS", "air"),
    alpha=f64([[0.0] * 3, [0.0, 0.02, 0.01], [0.0, -0.05, 0.02], [0.0, -0.1, 0.03], [0.0, -0.1, 0.02]]),
    semi_diameter=[0.52, 0.8, 0.9, 1.2, 1.5],
)
WITHOUT_SURFACE = {"US-12078784-B2-e6", "US20210165194A1"}  # extended aspheres


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("path", ZEMAX_FILES, ids=lambda path: path.stem)
def test_optiland_reads_what_we_write(tmp_path, path):
    """Surfaces, stop, aperture, fields and wavelengths are equal, and the focal length is within 5e-4."""
    imported = read_zemax(path)[0]
    zemax.write(tmp_path / "lens.zmx", imported)
    if path.stem in WITHOUT_SURFACE:
        with pytest.raises(ValueError, match="xasphere"):
            optiland.load_zemax_file(str(tmp_path / "lens.zmx"))
        return
    optic = optiland.load_zemax_file(str(tmp_path / "lens.zmx"))
    lens = imported.lens
    assert [float(r) for r in optic.surfaces.radii[1:-1]] == [1 / c if c else math.inf for c in lens.curvature.tolist()]
    assert optic.surfaces.stop_index == lens.stop + 1
    kinds = {"entrance_pupil_diameter_mm": "EPD", "f_number": "imageFNO"}
    if imported.aperture is not None:
        assert (optic.aperture.ap_type, float(optic.aperture.value)) == (
            kinds[imported.aperture[0]],
            imported.aperture[1],
        )
    assert sorted((float(f.x), float(f.y)) for f in optic.fields) == sorted(imported.fields[1])
    assert tuple(float(w.value) for w in optic.wavelengths) == imported.wavelengths_um
    efl = float(paraxial(lens, imported.wavelengths_um[imported.primary]).efl)
    assert float(optic.paraxial.f2()) == pytest.approx(efl, rel=5e-4)


@pytest.mark.filterwarnings("ignore")
def test_optiland_reads_a_lens_of_a_study(tmp_path):
    """The specification becomes fields and wavelengths; glasses have names that both programs know."""
    view = view_of_spec(Spec())
    zemax.write(tmp_path / "lens.zmx", with_system_data(Prescription(LENS), view))
    optic = optiland.load_zemax_file(str(tmp_path / "lens.zmx"))
    assert float(optic.paraxial.f2()) == pytest.approx(float(paraxial(LENS, view.reference_um).efl), rel=5e-4)
    assert optic.fields.num_fields == len(view.fields)
    assert optic.fields.max_y_field == pytest.approx(math.degrees(math.atan(float(view.tangents[:, 1].max()))))
    assert [float(wave.value) for wave in optic.wavelengths] == list(view.wavelengths_um)
    ours = zemax.read(tmp_path / "lens.zmx")
    assert ours.lens.media == LENS.media and ours.lens.curvature.tolist() == LENS.curvature.tolist()
