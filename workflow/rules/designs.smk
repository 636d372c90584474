"""Lenses and their point spread functions."""


rule design:
    """Design a lens, or import it; write its prescription, figures, history and PSFs."""
    input:
        train=design_images,
        weights=design_weights,
        files=imported_files,
        candidates=prescriptions(paper_tables.candidates),
        starts=prescriptions(paper_tables.starts),
        metrics=start_metrics,
    output:
        lens="results/{study}/lenses/{lens}/seed{seed}/lens.yaml",
        history="results/{study}/lenses/{lens}/seed{seed}/history.csv",
        psf="results/{study}/lenses/{lens}/seed{seed}/psf.safetensors",
    log:
        "results/{study}/logs/design/{lens}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/design/{lens}-seed{seed}.tsv"
    priority: early(0.5)  # most jobs wait for designs, which include the longest jobs
    resources:
        **needs("design") | {"gpu": lambda w: int(GPUS and study_of(w).lens(w.lens).reads_images)},
    params:
        **call("tasklens.jobs.design.run"),
        settings=settings(paper_tables.lens_design),
    script:
        "../scripts/job.py"


rule diffraction:
    """Compute the PSFs of a lens with diffraction."""
    input:
        lens=rules.design.output.lens,
    output:
        psf="results/{study}/lenses/{lens}/seed{seed}/psf_diffraction.safetensors",
    log:
        "results/{study}/logs/diffraction/{lens}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/diffraction/{lens}-seed{seed}.tsv"
    resources:
        **needs("diffraction"),
    params:
        **call("tasklens.jobs.diffraction.run"),
        settings=settings(job_settings.DiffractionJob.of),
    script:
        "../scripts/job.py"
