"""One sentence about each design of a study, from its settings; no torch here."""

from tasklens.settings.design_settings import GradientDesignSettings
from tasklens.settings.lens_entries import ImportedLens, LensEntry

_CRITERIA = {
    "task": "the loss of the frozen network",
    "spot": "the RMS spot radius",
    "image_error": "the squared error of the captures",
    "log_image_error": "the logarithm of the squared error of the captures (PSNR)",
    "correlation": "the correlation of captures and sharp images",
    "wiener_error": "the error of the captures after the best linear filter",
    "contrast": "the contrast (real part of the OTF) at a quarter and half of the Nyquist frequency",
}


def description(lens: LensEntry) -> str:
    """Describe how a lens is designed, in one sentence."""
    design = lens.design
    if isinstance(design, ImportedLens):
        return f"A lens from the file {design.file.name}, scaled to the specification."
    if not isinstance(design, GradientDesignSettings):
        spot = design.of_elements(lens.elements).spot_um
        stop = f" until the RMS spot is {spot:g} um" if spot else ""
        vignetting = (
            f", with apertures that stop up to {design.vignetting:.0%} of the light" if design.vignetting else ""
        )
        reference = design.reference.replace("_", " ")
        return f"Least squares on rays about the {reference}, from {design.starts} random starts{stop}{vignetting}."
    last = design.descents[-1]
    criterion = _CRITERIA[last.criterion]
    if design.task:
        criterion = f"the loss of a network for {design.task}"
    if last.network_learning_rate is not None:
        criterion = "the loss of a network trained together with the lens"
    verb = "Maximises" if last.criterion in ("correlation", "contrast") else "Minimises"
    steps = sum(descent.steps * descent.lenses for descent in design.descents)
    return f"{verb} {criterion}, {_start(design.start)}; {steps} lens evaluations."


def _start(start: str | tuple[str, ...]) -> str:
    if start == "flat":
        return "from flat plates"
    if start == "best_imaging":
        return "from the imaging lens with the best minival accuracy"
    if start == "best_spot":
        return "from the lens by spots or least squares with the best minival accuracy"
    return f"from {start[0]}" if len(start) == 1 else f"from the best of {', '.join(start)}"
