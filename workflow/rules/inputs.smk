"""Input files that depend on the study, as functions of wildcards; and targets at all points of a sweep."""


def design_images(wildcards):
    """Return the training images of a design, or for the focus of an imported lens, if it needs any."""
    entry = study_of(wildcards).lens(wildcards.lens)
    split = TRAINING_SCENES if entry.design.task else TRAIN if entry.reads_images else []
    return [path_of(pattern, study_of(wildcards)) for pattern in split]


def design_weights(wildcards):
    """Return the weights of the network that supervises a design or a focus, if there is one."""
    study = study_of(wildcards)
    entry = study.lens(wildcards.lens)
    if entry.design.task:
        return path_of(rules.task_reference.output.weights, study, task=entry.design.task)
    by_supervisor = entry.by_network or entry.may_focus
    return path_of(rules.reference.output.weights, study, classifier=study.supervisor) if by_supervisor else []


def imported_files(wildcards):
    """Return the files of an imported lens."""
    design = study_of(wildcards).lens(wildcards.lens).design
    return list(design.sources) if isinstance(design, ImportedLens) else []


def starting_lenses(wildcards):
    """Return the prescriptions of the lenses that a design may start from."""
    study = study_of(wildcards)
    keys = [LensKey(lens, wildcards.seed) for lens in table_contents.starts(study, wildcards.lens)]
    return paths_of(rules.design.output.lens, study, keys)


def start_metrics(wildcards):
    """Return the measurements of the lenses that a design may start from, if the most accurate one is its start."""
    study = study_of(wildcards)
    lenses = table_contents.starts(study, wildcards.lens) if study.lens(wildcards.lens).by_accuracy else ()
    keys = [MeasuredKey(lens, study.supervisor, wildcards.seed) for lens in lenses]
    return paths_of(rules.fine_tune.output.metrics, study, keys)


def psf(wildcards):
    """Return the PSFs of the lens of a job; none for sharp images."""
    lens, seed = wildcards.lens, wildcards.seed
    return [] if lens == names.SHARP else path_of(rules.psfs.output.psf, study_of(wildcards), lens=lens, seed=seed)


def sharp_weights(wildcards):
    """Return the weights of a classifier that was trained on the sharp images."""
    classifier = names.split(wildcards.measured_name)[0]
    return path_of(rules.reference.output.weights, study_of(wildcards), classifier=classifier)


def supervisor_weights(wildcards):
    """Return the weights of the supervisor that was fine-tuned on a lens."""
    study = study_of(wildcards)
    key = MeasuredKey(wildcards.lens, study.supervisor, wildcards.seed)
    return paths_of(rules.fine_tune.output.weights, study, [key])


def table_of(study, table):
    """Return the contents of a table of the paper."""
    contents = table_contents.table(study, table)
    if not contents.lenses:
        raise StudyError(f"{table}: the study has no lens for this table; add a design")
    return contents


def claim_inputs(claims):
    """Return the inputs of a table of claims: files of lenses, metrics and predictions; for `claims`, see `contents`."""
    return {
        "lenses": files_of(rules.design.output.lens, claims),
        "metrics": files_of(rules.fine_tune.output.metrics, claims, "measured_keys"),
        "predictions": files_of(rules.fine_tune.output.predictions, claims, "measured_keys"),
    }


def design_benchmarks(wildcards):
    """Return the benchmarks of designs; they are not inputs, or a missing one would repeat its design."""
    return {"benchmarks": files_of(rules.design.benchmark, paper_effort.effort)(wildcards)}


def optional_files(wildcards):
    """Return tables and figures that the page shows if they exist; they are not inputs, since they need more lenses."""
    study = study_of(wildcards)
    patterns = [
        rules.merit_function_table.output.csv,
        rules.tolerances_table.output.csv,
        rules.tolerances_table.output.compared_csv,
    ]
    patterns += [rules.tasks_table.output.csv] if study.tasks.networks else []
    tables = [path_of(pattern, study) for pattern in patterns]
    tables += [path_of(rules.ablation.output.csv, study, ablation=name) for name in study.ablations]
    return {
        "optional": tables,
        "drawn": [path_of(rules.merit_function_table.output.figure, study)],
        "benchmarks": f"results/{study.name}/benchmarks",
    }


def tables_of(pattern):
    """Return a function from wildcards to the files of all tables on a page."""
    return lambda w: [
        path_of(pattern, study_of(w), table=contents.name) for contents in table_contents.tables(study_of(w))
    ]


def tables_of_points(wildcards):
    """Return the tables of all points of a sweep."""
    return [
        path_of(rules.table.output.csv, study_named(f"{wildcards.study}/{point}"), table=table)
        for point, table in report_jobs.SweepJob.of(study_of(wildcards)).tables
    ]


def verification(study):
    """Return the contents of the verification of a study."""
    if study.sweep:
        raise StudyError(
            "verify: a sweep is verified point by point, with --configfile results/<study>/<point>/study.yaml"
        )
    return table_contents.verification(study)


def no_ablation(wildcards):
    """Raise StudyError for the target of an ablation that the study of the configuration does not have."""
    targets = ", ".join(f"ablation_{name}" for name in STUDY.ablations)
    advice = f"expected {targets}" if targets else "add it to `ablations`"
    raise StudyError(f"ablation_{wildcards.unknown}: {STUDY.name} has no such ablation; {advice}")


def at_points(pattern, **wildcards):
    """Return the file of a pattern at every point of the study."""
    return [path_of(pattern, study, **wildcards) for study in POINTS]


def of_all_lenses(pattern):
    """Return the files of all lenses, at every point of the study."""
    return [
        path_of(pattern, study, lens=lens, seed=seed)
        for study in POINTS
        for lens in study.lenses
        for seed in study.seeds
    ]


def compared_figures(pattern):
    """Return the figures of all elements with a task-driven and an imaging lens."""
    return [
        path_of(pattern, study, elements=elements, seed=seed)
        for study in POINTS
        for elements in paper_claims.claims_by_elements(study)
        for seed in study.seeds
    ]
