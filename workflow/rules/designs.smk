"""Lenses, and their point spread functions (PSFs)."""


rule design:
    """Design a lens, or import it; write its prescription, figures and history."""
    input:
        train=design_images,
        weights=design_weights,
        files=imported_files,
        starts=starting_lenses,
        metrics=start_metrics,
    output:
        lens="results/{study}/lenses/{lens}/seed{seed}/lens.yaml",
        history="results/{study}/lenses/{lens}/seed{seed}/history.csv",
    log:
        "results/{study}/logs/design/{lens}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/design/{lens}-seed{seed}.tsv"
    priority: early(0.5)  # most jobs wait for designs, which include the longest jobs
    resources:
        **needs("design") | {"gpu": lambda w: int(GPUS and study_of(w).lens(w.lens).reads_images)},
    params:
        **call("tasklens.study.jobs.design_lens.run"),
        settings=settings(table_contents.lens_design),
    script:
        "../scripts/job.py"


rule psfs:
    """Compute the PSFs of a lens at the fields where networks are trained, lenses chosen, and lenses graded."""
    input:
        lens=rules.design.output.lens,
    output:
        psf="results/{study}/lenses/{lens}/seed{seed}/psf.safetensors",
    log:
        "results/{study}/logs/psfs/{lens}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/psfs/{lens}-seed{seed}.tsv"
    priority: early(0.5)
    resources:
        **needs("psfs"),
    params:
        **call("tasklens.study.jobs.psfs.run"),
        settings=settings(job_settings.PsfJob.of),
    script:
        "../scripts/job.py"
