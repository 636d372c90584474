"""Checks of a study before its first job: images, imported lenses, networks; compiles the tracer."""

from tasklens.optics.tracing.trace import compile_tracer
from tasklens.recognition import class_folders, object_splits
from tasklens.runtime.files import FileError
from tasklens.study import consistency
from tasklens.study.lens_entries import ImportedLens
from tasklens.study.study import Study


def check(study: Study, networks: bool, weights: bool) -> None:
    """Check what a study reads, and compile the tracer where it is not yet.

    Args:
        networks: build every network once, without weights; and check that the folders of classes are named by
            WordNet ids where a network has ImageNet's outputs.
        weights: look for the files of weights of all classifiers.

    Raises:
        InputError: names what cannot be used.
    """
    class_folders.check(study.images)
    object_splits.check(study.tasks.scenes)
    for name, classifier in study.classifiers.items():
        if weights and classifier.weights is not None and not classifier.weights.is_file():
            raise FileError(f"classifiers.{name}.weights = {classifier.weights}: no such file; correct the path")
    compile_tracer()
    if study.imported:
        from tasklens.optics.io import imported
        from tasklens.optics.view import view_of_spec

        for lens in study.lenses.values():
            if isinstance(lens.design, ImportedLens):
                spec = study.lens_spec(lens.name)
                imported.fit(lens.design, view_of_spec(spec), spec.f_number, study.evaluation_rays)
    if networks:
        _check_networks(study)


def _check_networks(study: Study) -> None:
    from tasklens.recognition import classifiers

    for name, classifier in study.classifiers.items():
        classifiers.check(name, classifier, study.images.size)
        if classifier.pretrained:
            classifiers.check_published(classifier.model)
        if classifier.outputs != "classes" and study.images.folder is not None:
            classifiers.imagenet_outputs(class_folders.training_classes(study.images.folder))
    if study.tasks.networks:
        from tasklens.recognition import task_networks

        for name, network in study.tasks.networks.items():
            task_networks.build(name, network.model_copy(update={"pretrained": False}), 2, study.tasks.scenes.size)
    sizes = {
        f"{where}.descents.{k}.size": part.size
        for where, lens in consistency.places(study)
        for k, part in enumerate(lens.descents)
        if part.criterion == "task" and part.size is not None
    }
    for where, size in sizes.items():
        classifiers.check(f"{study.supervisor} for {where}", study.classifiers[study.supervisor], size)
