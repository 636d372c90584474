"""Checks of a study across its sections: names, networks, lenses and ablations; no torch here."""

from typing import Any

from pydantic import ValidationError

from tasklens.fields import SELECTION
from tasklens.settings import feasibility, starts
from tasklens.settings import field_settings as fields
from tasklens.settings.capture_settings import CaptureSettings
from tasklens.settings.design_settings import DesignSettings, GradientDesignSettings
from tasklens.settings.least_squares_settings import LeastSquaresSettings
from tasklens.settings.lens_entries import ImportedLens, LensEntry
from tasklens.settings.messages import in_words
from tasklens.study.study import Study

_RESERVED = {  # names by section, and their use
    "elements": dict.fromkeys(("figure3", "figure4"), "files of comparisons"),
    "designs": {"reference": "the sharp images in tables"},
    "imported": {"reference": "the sharp images in tables"},
}


def check(study: Study) -> None:
    """Check the references between the sections of a study; raises ValueError with the key."""
    if not study.lenses:
        raise ValueError("designs: expected a design of some elements, or a lens that is `imported`")
    _check_names(study)
    for name, design in study.designs.items():
        _check_references(study, f"designs.{name}", design)
    for name in study.ablations:
        _check_ablation(study, name)
    _check_fields(study)
    _check_networks(study)
    _check_lenses(study)


def _check_names(study: Study) -> None:
    for section, uses in _RESERVED.items():
        for name, use in uses.items():
            if name in getattr(study, section):
                raise ValueError(f"{section}.{name}: this name is reserved for {use}; rename these {section}")
    if study.supervisor not in study.classifiers:
        raise ValueError(f"supervisor: {study.supervisor!r} is not one of {', '.join(study.classifiers)}")
    for name in study.imported:
        if name in study.designs:
            raise ValueError(f"imported.{name}: `designs` has the same name; rename one")
    elements = dict.fromkeys([*study.elements, *(lens.elements for lens in study.imported.values())])
    for name in study.specs:
        if name not in elements:
            raise ValueError(f"specs.{name}: expected elements of the study, one of {', '.join(elements)}")
    for section in ("tolerances", "tasks"):
        for name in getattr(study, section).designs or ():
            if name not in study.designs and name not in study.imported and name not in study.lenses:
                choices = ", ".join([*study.designs, *study.imported])
                raise ValueError(f"{section}.designs: {name!r} is not one of {choices}, nor a lens")
    for name in study.restored or ():
        if name not in elements:
            raise ValueError(f"restored: {name!r} is not one of {', '.join(elements)}")


def _check_fields(study: Study) -> None:
    """Check that sets of fields reach from axis to corner, and that lenses are graded where nothing was chosen."""
    grading = sum(study.fields.graded_points, ())
    fields.check_set(grading, study.spec.aspect, "fields.grading")
    seen = {"fields.design": study.fields.design_points}
    for where, lens in lenses_with_keys(study):
        if lens.fields is not None:
            seen[f"{where}.fields"] = study.design_points(lens.name)
    for where, points in seen.items():
        if points is not None:
            fields.check_set(points, study.spec.aspect, where)
            if study.fields.grading != "paper":
                fields.check_unseen(grading, points, where)
    if study.fields.grading != "paper":
        fields.check_unseen(grading, sum(SELECTION, ()), "the choice among lenses")


def _check_references(study: Study, where: str, design: DesignSettings | ImportedLens) -> None:
    """Check the names of elements and of a task in a design."""
    if isinstance(design, LeastSquaresSettings):
        spots = design.spot_um if isinstance(design.spot_um, dict) else study.elements
        if missing := [elements for elements in study.elements if elements not in spots]:
            raise ValueError(f"{where}.spot_um: expected a value for {', '.join(missing)}, too")
    elif design.task is not None:
        networks = study.tasks.networks
        if design.task not in networks:
            raise ValueError(
                f"{where}.task: {design.task!r} is not one of `tasks.networks`: {', '.join(networks) or 'none'}"
            )
        weighted = any(descent.corner_weight != 1 for descent in design.by_network)
        if weighted and networks[design.task].kind != "segmentation":
            raise ValueError(f"{where}: corner_weight: a network that detects objects has one loss for all captures")


def _check_ablation(study: Study, name: str) -> None:
    ablation = study.ablations[name]
    for key, section in (("elements", study.elements), ("design", study.designs)):
        if getattr(ablation, key) not in section:
            raise ValueError(f"ablations.{name}.{key}: {getattr(ablation, key)!r} is not one of {', '.join(section)}")
    lenses = {}
    for variant in ablation.variants:
        try:
            lenses[variant] = study.variant(name, variant)
        except ValidationError as error:
            settings: Any = CaptureSettings if error.title == CaptureSettings.__name__ else DesignSettings
            raise ValueError(in_words(f"ablations.{name}.variants.{variant}", error, settings)) from None
        design_names = [*study.designs, *study.imported]
        design_names += [item.name(key, other) for key, item in study.ablations.items() for other in item.variants]
        if design_names.count(lenses[variant].design_name) > 1:
            other = lenses[variant].design_name
            raise ValueError(f"ablations.{name}: another design is also called {other}; rename one")
        spots = ablation.variants[variant].get("spot_um")
        if isinstance(spots, dict) and ablation.elements not in spots:
            raise ValueError(
                f"ablations.{name}.variants.{variant}.spot_um: expected a value for {ablation.elements}, too"
            )
        _check_references(study, f"ablations.{name}.variants.{variant}", lenses[variant].design)
    base = study.lens(f"{ablation.elements}-{ablation.design}").design
    seen = [((base, study.capture, study.fields.design), "the design itself")]
    for variant, entry in lenses.items():
        values = entry.design, entry.capture or study.capture, entry.fields or study.fields.design
        if same := [words for others, words in seen if others == values]:
            raise ValueError(
                f"ablations.{name}.variants.{variant}: has the same values as {same[0]}; change one, or remove it"
            )
        seen.append((values, f"the variant {variant}"))


def _check_networks(study: Study) -> None:
    batches = {"fine_tuning": study.fine_tuning.batch_size, "restoration": study.restoration.batch_size}
    batches |= {f"classifiers.{k}.training": v.training.batch_size for k, v in study.classifiers.items() if v.training}
    for where, images in batches.items():
        feasibility.check_step(f"{where}.batch_size", images, study.images.size)
    for name, classifier in study.classifiers.items():
        if study.images.folder is None and classifier.outputs != "classes":
            raise ValueError(
                f"classifiers.{name}.outputs: {classifier.outputs!r} needs photographs, `images.folder`, whose classes "
                "are named by WordNet ids"
            )
    if study.images.size % study.restoration.multiple:
        raise ValueError(
            f"images.size: {study.images.size} is not a multiple of {study.restoration.multiple}, which the "
            f"restoration network of {len(study.restoration.encoder)} levels needs"
        )


def _check_lenses(study: Study) -> None:
    sizes = {"images.size": study.images.size}
    if study.tasks.networks:
        sizes["tasks.scenes.size"] = study.tasks.scenes.size
    for name, plastics in study.elements.items():
        materials = tuple(study.materials[plastic] for plastic in plastics)
        where = f"specs.{name}" if name in study.specs else "spec"
        spec = study.spec_of(name)
        if spec.object_distance_mm is not None and study.designs:
            raise ValueError(
                f"{where}.object_distance_mm: designs need an object at infinity; use only imported lenses"
            )
        feasibility.check(name, where, materials, spec, study.constraints)
        feasibility.check_window(f"{where}.kernel_size: half of", spec.kernel_size, sizes)
    for where, lens in lenses_with_keys(study):
        kernel_size = study.lens_spec(lens.name).kernel_size
        if isinstance(lens.design, ImportedLens):
            feasibility.check_window(f"imported.{lens.design_name}: half of its kernel_size =", kernel_size, sizes)
        elif isinstance(lens.design, GradientDesignSettings):
            feasibility.check_descents(where, lens.design, kernel_size, study.images.size)
            _check_start(study, where, lens, lens.design)


def lenses_with_keys(study: Study) -> list[tuple[str, LensEntry]]:
    """Return all lenses and variants, each with the key of its design."""
    entries = [(f"designs.{lens.design_name}", lens) for lens in study.lenses.values()]
    for name, item in study.ablations.items():
        entries += [(f"ablations.{name}.variants.{other}", study.variant(name, other)) for other in item.variants]
    return entries


def _check_start(study: Study, where: str, lens: LensEntry, design: GradientDesignSettings) -> None:
    imported = [name for name, other in study.imported.items() if other.elements == lens.elements]
    starts.check(where, lens.design_name, design, study.designs, imported)
    for name in design.starting_designs:
        if name in study.imported:
            _check_imported_start(study, where, lens, name)
    _check_acyclic(study, where, lens.design_name, design)


def _check_imported_start(study: Study, where: str, lens: LensEntry, name: str) -> None:
    """Check that an imported lens, the start of a design, has the specification of the design; raises ValueError."""
    specs = (study.lens_spec(other) for other in (f"{lens.elements}-{name}", lens.name))
    start, design = (spec.model_dump(exclude={"kernel_size"}, exclude_computed_fields=True) for spec in specs)
    if changed := [key for key in design if start[key] != design[key]]:
        raise ValueError(
            f"{where}.start: imported.{name}.spec has another {', '.join(changed)} than the design; remove it "
            "there, or import the lens twice"
        )


def _check_acyclic(study: Study, where: str, name: str, design: DesignSettings) -> None:
    """Check that no design starts from itself, directly or by way of other designs; raises ValueError."""
    first = starts.starting_designs(design, study.designs)
    queue, seen = list(first), set()
    while queue:
        other = queue.pop()
        if other == name:
            raise ValueError(f"{where}.start: {name} would start from itself, through {', '.join(first)}")
        if other not in seen:
            seen.add(other)
            queue += starts.starting_designs(study.designs[other], study.designs) if other in study.designs else ()
