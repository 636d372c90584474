"""Checks of a study before its first job: images, imported lenses, networks; compiles the tracer."""

import sys
from collections.abc import Mapping

from tasklens.optics.lens import Lens
from tasklens.optics.tracing.trace import compile_tracer
from tasklens.recognition import class_folders, coco
from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError
from tasklens.settings.image_settings import RENDERED_CLASSES
from tasklens.settings.lens_entries import ImportedLens
from tasklens.study import consistency
from tasklens.study.study import Study
from tasklens.study.table_contents import starts


def check(study: Study, networks: bool, weights: bool) -> None:
    """Check the inputs of a study, and compile the tracer if necessary.

    Args:
        networks: build every network once; if a network has ImageNet's outputs, check that the class folders have
            WordNet ids as names.
        weights: check that the weight files of all classifiers exist; with `networks`, read them.

    Raises:
        InputError: an input cannot be used; the message names it.
    """
    class_folders.check(study.images)
    if study.tasks.scenes.folder is not None:
        coco.split_names(study.tasks.scenes.folder)
    for name, classifier in study.classifiers.items():
        if weights and classifier.weights is not None and not classifier.weights.is_file():
            raise FileError(f"classifiers.{name}.weights = {classifier.weights}: no such file; correct the path")
    compile_tracer()
    if study.imported:
        from tasklens.optics.io import imported
        from tasklens.optics.view import view_of_spec

        read = {}
        for lens in study.lenses.values():
            if isinstance(lens.design, ImportedLens):
                spec = study.lens_spec(lens.name)
                fitted = imported.fit(lens.design, view_of_spec(spec), spec.f_number)
                read[lens.name], origin = fitted
                for remark in origin.get("assumptions", ()):
                    print(f"tasklens: {lens.design.file}: {remark}", file=sys.stderr)
        _check_free(study, read)
    if networks:
        _check_networks(study, weights)


def _check_free(study: Study, imported_lenses: Mapping[str, Lens]) -> None:
    """Check the free surfaces of designs that start from imported lenses; raises InputError."""
    from tasklens.design.variables import Variables

    for lens in study.lenses.values():
        if lens.design.free is None:
            continue
        for name in imported_lenses.keys() & starts(study, lens.name):
            try:
                Variables.plain(imported_lenses[name]).free(lens.design.free)
            except InputError as error:
                raise InputError(f"designs.{lens.design_name}, which may start from {name}: {error}") from None


def _check_networks(study: Study, weights: bool) -> None:
    from tasklens.recognition import classifiers, networks

    folder = study.images.folder
    classes = [str(k) for k in range(RENDERED_CLASSES)] if folder is None else class_folders.training_classes(folder)
    for name, classifier in study.classifiers.items():
        classifiers.check(name, classifier, study.images.size, len(classes))
        if weights and classifier.weights is not None:
            classifiers.build(classifier, classes)
        if classifier.pretrained:
            networks.check_published(classifier.model)
        if classifier.outputs != "classes" and folder is not None:
            classifiers.imagenet_outputs(classes)
    if study.tasks.networks:
        from tasklens.recognition import task_networks

        for name, network in study.tasks.networks.items():
            task_networks.build(name, network.model_copy(update={"pretrained": False}), 2, study.tasks.scenes.size)
    sizes = {
        f"{place}.descents.{k}.size": part.size
        for place, lens in consistency.lenses_with_keys(study)
        for k, part in enumerate(lens.design.descents)
        if part.criterion == "task" and part.size is not None
    }
    for place, size in sizes.items():
        classifiers.check(f"{study.supervisor} for {place}", study.classifiers[study.supervisor], size, len(classes))
