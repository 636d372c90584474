"""Settings of lenses built in simulation, and contents of their table; no torch here."""

from tasklens.settings.base import Frozen
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.field_settings import Points
from tasklens.settings.network_settings import ClassifierSettings
from tasklens.settings.specification import Spec
from tasklens.settings.tolerance_settings import ToleranceSettings
from tasklens.study.study import Study, StudyError
from tasklens.study.table_contents import SeededLenses, chosen_lenses


class ProductionJob(Frozen):
    """Lenses of a design, built in simulation with manufacturing errors.

    Attributes:
        centres: fields of focus and spots, the centres of the cells of the grading.
        grading: fields of the images, which take them in turns.
    """

    lens: str
    seed: int
    spec: Spec
    centres: Points
    grading: tuple[Points, ...]
    capture: CaptureSettings
    classifier: ClassifierSettings
    tolerances: ToleranceSettings

    @classmethod
    def of(cls, study: Study, lens: str, seed: int) -> "ProductionJob":
        """Return the settings of the job; raises StudyError if captures have diffraction."""
        capture = study.capture_of(lens)
        check_rays_alone(capture)
        return cls(
            lens=lens,
            seed=seed,
            spec=study.lens_spec(lens),
            centres=study.fields.grading_points,
            grading=study.fields.graded_points,
            capture=capture,
            classifier=study.classifier(study.supervisor),
            tolerances=study.tolerances.model_copy(update={"designs": None}),
        )


class BuiltContents(SeededLenses):
    """Contents of the table of built lenses.

    Attributes:
        study: name of the study.
        lenses: names of the lenses.
        pairs: task-driven lens and imaging lens of the same elements.
        seeds: seeds of the study.
        grade: name of the tolerance grade.
        built, images: numbers of built lenses of each design, and of images that measure each, at most.
    """

    study: str
    pairs: tuple[tuple[str, str], ...]
    grade: str
    built: int
    images: int


def check_rays_alone(capture: CaptureSettings) -> None:
    """Raise StudyError if captures have diffraction, which built lenses do not have."""
    if capture.diffraction:
        raise StudyError(
            "tolerances: built lenses have no diffraction, but the classifiers of this study are trained on captures "
            "with diffraction; expected `capture: {diffraction: false}`"
        )


def built_contents(study: Study) -> BuiltContents:
    """Return the contents of the table of built lenses: the lenses of table 1, or of the requested designs.

    Raises:
        StudyError: captures have diffraction.
    """
    check_rays_alone(study.capture)
    lenses = [study.lens(name) for name in chosen_lenses(study, study.tolerances.designs)]
    pairs = (
        (lens.name, other.name)
        for lens in lenses
        for other in lenses
        if lens.by_task and not other.by_network and lens.elements == other.elements
    )
    return BuiltContents(
        study=study.name,
        lenses=tuple(lens.name for lens in lenses),
        pairs=tuple(pairs),
        seeds=study.seeds,
        grade=study.tolerances.grade.name,
        built=study.tolerances.lenses,
        images=study.tolerances.images,
    )
