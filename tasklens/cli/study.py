"""`tasklens study ...`: study files."""

from pathlib import Path
from typing import Annotated

import typer

from tasklens.study.loading import load

app = typer.Typer(no_args_is_help=True)
app.callback()(lambda: None)  # a group, whatever the number of its commands


@app.command()
def check(
    study: Annotated[Path, typer.Argument(help="Study file (YAML).", show_default=False)],
    networks: Annotated[bool, typer.Option("--networks", help="Build every classifier once, without weights.")] = False,
) -> None:
    """Check a study file and its imported lenses, compile the tracer where it is not yet, and print a summary."""
    from tasklens.optics.tracing.trace import compile_tracer

    found = load(study)
    compile_tracer()
    if found.imported:
        from tasklens.design import imported
        from tasklens.optics.view import view_of_spec

        for entry in found.imported.values():
            spec = found.spec_of(entry.elements)
            imported.fit(entry, view_of_spec(spec), spec.f_number, found.evaluation_rays)
    if networks:
        from tasklens.recognition import classifiers

        for name, classifier in found.classifiers.items():
            classifiers.check(name, classifier, found.images.size)
        for name, design in found.designs.items():
            if size := getattr(design, "size", None):
                classifiers.check(f"{found.supervisor} for designs.{name}", found.classifiers[found.supervisor], size)
    print(f"{found.name}: {len(found.lenses)} lenses, {len(found.classifiers)} classifiers, seeds {list(found.seeds)}")
