"""One front door: what a rule of the workflow calls is what a person can type.

    tasklens design config/config.yaml doublet-tasklens --seed 0

Files are read and written below results/<study name>/. torch is imported inside the commands that need it.
"""

import argparse
import sys
import warnings

from tasklens.pipeline.arguments import parser
from tasklens.pipeline.stages import measure, report
from tasklens.runtime.files import FileError
from tasklens.study.study import Study, StudyError


def analyse(args: argparse.Namespace) -> None:
    """print the table of a lens: its figures by field and its aberrations by surface, newly computed from its file"""
    from tasklens.optics.analysis.datasheet import figures, seidel_by_surface, view_of
    from tasklens.optics.io import prescription
    from tasklens.report import certificate

    found, content = prescription.read(args.file)
    lens = found.lens
    view = view_of(lens, content, str(args.file))
    computed = content | {"figures": figures(lens, view, args.rays)}
    print(certificate.markdown(str(args.file), view.fields.tolist(), computed, seidel_by_surface(lens, view)), end="")


def check(study: Study, args: argparse.Namespace) -> None:
    """say what a study file describes, or what is wrong with it and with its lenses from outside"""
    if study.outside:
        from tasklens.design import imported as outside
        from tasklens.optics.view import view_of_spec

        for entry in study.outside.values():
            spec = study.spec_of(entry.elements)
            outside.fit(entry, view_of_spec(spec), spec.f_number, study.evaluation_rays)
    if args.networks:
        from tasklens.recognition import classifiers

        for name, classifier in study.classifiers.items():
            classifiers.check(name, classifier, study.images.size)
        for name, design in study.designs.items():
            if size := getattr(design, "size", None):
                classifiers.check(f"{study.supervisor} for designs.{name}", study.classifiers[study.supervisor], size)
    print(f"{study.name}: {len(study.lenses)} lenses, {len(study.classifiers)} classifiers, seeds {list(study.seeds)}")


STAGES = {
    check: ("--networks",),
    measure.images: ("--threads",),
    measure.reference: ("classifier",),
    measure.design: ("lens", "--seed"),
    measure.psf: ("lens", "--seed"),
    measure.tail: ("lens", "--seed"),
    report.certificate: ("lens", "--seed"),
    measure.restore: ("lens", "--seed"),
    measure.fine_tune: ("lens", "classifier", "--seed", "--restored"),
    measure.reproduce: ("lens", "classifier", "--seed", "--restored"),
    report.table: ("table", "--partial"),
    report.psf_tail: (),
    report.verdicts: (),
    report.regimes: (),
    report.ablation: ("ablation",),
    report.verify: (),
    report.figure: ("lens", "--seed"),
    report.comparison: ("elements", "--seed"),
}


def main(argv: list[str] | None = None) -> int:
    """Run one stage; a mistake in the study or its data ends in exit status 2, a failed `verify` in 1."""
    args = parser(__doc__.splitlines()[0], STAGES, analyse).parse_args(argv)
    # torch's word to itself, at the first forward-mode derivative of a process
    warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", FutureWarning)
    try:
        return args.run(args) or 0
    except (StudyError, FileError, FileNotFoundError) as error:
        print(f"tasklens: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
