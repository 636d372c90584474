"""Input files that depend on the study, as functions of wildcards; and targets at all points of a sweep."""


def design_images(wildcards):
    """Return the training images of a design, if it has any."""
    entry = study_of(wildcards).lens(wildcards.lens)
    split = TRAINING_SCENES if entry.other_task else TRAIN if entry.supervised else []
    return [path for pattern in split for path in paths(pattern, study_of(wildcards))]


def design_weights(wildcards):
    """Return the weights of the network that supervises a design, if there is one."""
    study = study_of(wildcards)
    entry = study.lens(wildcards.lens)
    if entry.other_task:
        return paths(rules.task_reference.output.weights, study, task=entry.other_task)
    return paths(rules.reference.output.weights, study, classifier=study.supervisor) if entry.classified else []


def imported_files(wildcards):
    """Return the files of an imported lens."""
    design = study_of(wildcards).lens(wildcards.lens).design
    return list(design.sources) if isinstance(design, ImportedLens) else []


def lens_files_of(lenses):
    """Return a function from wildcards to the prescriptions of the lenses that a design may start from."""

    def files(wildcards):
        study = study_of(wildcards)
        keys = [(lens, wildcards.seed) for lens in lenses(study, wildcards.lens)]
        return paths(rules.design.output.lens, study, keys)

    return files


def start_metrics(wildcards):
    """Return the measurements of the lenses, the most accurate of which is the start of a design."""
    study = study_of(wildcards)
    keys = [(lens, study.supervisor, wildcards.seed) for lens in paper_tables.starts(study, wildcards.lens)]
    return paths(rules.fine_tune.output.metrics, study, keys)


def psf_files(study, keys):
    """Return the PSFs of lenses by (lens, seed), with diffraction if captures have it; none for sharp images."""
    files = []
    for lens, seed in keys:
        if lens != names.SHARP:
            rule_of_psf = rules.diffraction if study.capture_of(lens).diffraction else rules.design
            files += paths(rule_of_psf.output.psf, study, [(lens, seed)])
    return files


def psf(wildcards):
    """Return the PSFs of the lens of a job."""
    return psf_files(study_of(wildcards), [(wildcards.lens, wildcards.seed)])


def sharp_weights(wildcards):
    """Return the weights of a classifier that was trained on the sharp images."""
    classifier = names.split(wildcards.measured_name)[0]
    return paths(rules.reference.output.weights, study_of(wildcards), classifier=classifier)


def processes(wildcards):
    """Return the size of the process group that fine-tunes a classifier."""
    return study_of(wildcards).classifier(names.split(wildcards.measured_name)[0]).processes


def supervisor_weights(wildcards):
    """Return the weights of the supervisor that was fine-tuned on a lens."""
    study = study_of(wildcards)
    return paths(rules.fine_tune.output.weights, study, [(wildcards.lens, study.supervisor, wildcards.seed)])


def drawn_lenses(wildcards):
    """Return (lens, seed) of the lenses whose PSFs are drawn for the table of tasks."""
    study = study_of(wildcards)
    return [(lens, study.seeds[0]) for lens in task_jobs.tasks(study).drawn]


def comparison_of(wildcards):
    """Return the settings of a figure that compares lenses."""
    return report_jobs.ComparisonJob.of(study_of(wildcards), wildcards.elements, int(wildcards.seed))


def compared_lenses(wildcards):
    """Return (lens, seed) of the lenses that a figure may compare."""
    return [(lens, wildcards.seed) for lens in comparison_of(wildcards).lenses]


def of_first_seed(pattern, keys):
    """Return a function from wildcards to the files of the first seed; `keys` takes the study, and returns tuples."""

    def files(wildcards):
        study = study_of(wildcards)
        return paths(pattern, study, [(*key, study.seeds[0]) for key in keys(study)])

    return files


def table_of(wildcards):
    """Return the contents of a table of the paper."""
    return paper_tables.table(study_of(wildcards), wildcards.table)


def compared(claims):
    """Return the inputs of a table of claims: files of lenses, metrics and predictions; `claims` takes wildcards."""
    return {
        "lenses": lambda w: paths(rules.design.output.lens, study_of(w), claims(w).lens_keys),
        "metrics": lambda w: paths(rules.fine_tune.output.metrics, study_of(w), claims(w).measured_keys),
        "predictions": lambda w: paths(rules.fine_tune.output.predictions, study_of(w), claims(w).measured_keys),
    }


def design_benchmarks(wildcards):
    """Return the benchmarks of designs; they are not inputs, since Snakemake writes them at the end of a job."""
    study = study_of(wildcards)
    return {"benchmarks": paths(rules.design.benchmark, study, paper_effort.effort(study).lens_keys)}


def optional_files(wildcards):
    """Return tables and figures that the page shows if they exist; they are not inputs, since they need more lenses."""
    study = study_of(wildcards)
    patterns = [rules.regimes_table.output.csv, rules.merit_function_table.output.csv]
    patterns += [rules.tolerances_table.output.csv, rules.tolerances_table.output.compared_csv]
    patterns += [rules.tasks_table.output.csv] if study.tasks.networks else []
    tables = [path for pattern in patterns for path in paths(pattern, study)]
    tables += [path for name in study.ablations for path in paths(rules.ablation.output.csv, study, ablation=name)]
    return {
        "optional": tables,
        "drawn": paths(rules.merit_function_table.output.figure, study),
        "benchmarks": f"results/{study.name}/benchmarks",
    }


def of_shown_lenses(pattern):
    """Return a function from wildcards to the files of all lenses on the page."""
    return of_first_seed(pattern, lambda study: [(lens,) for lens in paper_tables.table_lenses(study)])


def tables_of(pattern):
    """Return a function from wildcards to the files of all tables on the page."""
    return lambda w: [
        path
        for contents in paper_tables.tables(study_of(w))
        for path in paths(pattern, study_of(w), table=contents.name)
    ]


def tables_of_points(wildcards):
    """Return the tables of all points of a sweep."""
    return [
        path
        for point, table in report_jobs.SweepJob.of(study_of(wildcards)).tables
        for path in paths(rules.table.output.csv, study_named(f"{wildcards.study}/{point}"), table=table)
    ]


def verified(pattern, keys):
    """Return the files that a verification of the study of the configuration reads; `keys` takes its contents."""

    def files(wildcards):
        if STUDY.sweep:
            raise StudyError(
                "verify: a sweep is verified point by point, with --configfile results/<study>/<point>/study.yaml"
            )
        return paths(pattern, STUDY, keys(paper_tables.verification(STUDY)))

    return files


def at_points(pattern, keys=lambda study: ((),), **fixed):
    """Return the files of a pattern at every point of the study; `keys` takes the study, and returns wildcards."""
    return [path for study in POINTS for path in paths(pattern, study, keys(study), **fixed)]


def lens_keys(study):
    """Return (lens, seed) of all lenses of a study."""
    return [(lens, seed) for lens in study.lenses for seed in study.seeds]


def compared_figures(pattern):
    """Return the figures of all elements with a task-driven and an imaging lens."""
    return [
        path
        for study in POINTS
        for elements in paper_claims.claims_by_elements(study)
        for path in paths(pattern, study, [(seed,) for seed in study.seeds], elements=elements)
    ]
