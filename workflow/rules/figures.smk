"""Pages and drawings of lenses; captures."""


rule certificate:
    """Write the page of a lens, with limits and manufacturability, its Zemax file, and drawings for the report."""
    input:
        lens=rules.design.output.lens,
        psf=psf,
    output:
        page="results/{study}/lenses/{lens}/seed{seed}/certificate.md",
        zemax="results/{study}/lenses/{lens}/seed{seed}/{lens}.zmx",
        catalogue="results/{study}/lenses/{lens}/seed{seed}/{lens}.agf",  # empty if makers' catalogues have its glasses
        section="results/{study}/lenses/{lens}/seed{seed}/section.svg",
        spots="results/{study}/lenses/{lens}/seed{seed}/spots.webp",
        psfs="results/{study}/lenses/{lens}/seed{seed}/psfs.webp",
        curves="results/{study}/lenses/{lens}/seed{seed}/curves.webp",
    log:
        "results/{study}/logs/certificate/{lens}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/certificate/{lens}-seed{seed}.tsv"
    priority: early()
    resources:
        **needs("certificate"),
    params:
        **call("tasklens.study.jobs.certify.run"),
        settings=named(
            name=lambda study, lens: lens,
            seed=lambda study, seed: seed,
            grade=lambda study: study.tolerances.grade,
        ),
    script:
        "../scripts/job.py"


rule drawing:
    """Draw a lens as one figure: cross-section, spot diagrams, PSFs, ray fans, MTF and encircled energy."""
    input:
        lens=rules.design.output.lens,
        psf=psf,
    output:
        figure=report_output(
            "results/{study}/figures/{lens}-seed{seed}.png", "drawing", "Lenses", lens="{lens}", seed="{seed}"
        ),
        figure_svg="results/{study}/figures/{lens}-seed{seed}.svg",
        figure_pdf="results/{study}/figures/{lens}-seed{seed}.pdf",
    log:
        "results/{study}/logs/drawing/{lens}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/drawing/{lens}-seed{seed}.tsv"
    wildcard_constraints:
        lens=r"(?!figure[34]-)[a-z0-9_]+-[a-z0-9_]+",  # not figures 3 and 4, which are in the same folder
    resources:
        **needs("drawing"),
    params:
        **call("tasklens.study.jobs.lens_figures.draw"),
        settings=named(name=lambda study, lens: lens),
    script:
        "../scripts/job.py"


rule comparison:
    """Draw the task-driven lenses of some elements and the best imaging lens (figure 3)."""
    input:
        lenses=files_of(rules.design.output.lens, paper_claims.comparison),
        psfs=files_of(rules.psfs.output.psf, paper_claims.comparison),
        metrics=files_of(rules.fine_tune.output.metrics, paper_claims.comparison, "baseline_keys"),
    output:
        figure=report_output(
            "results/{study}/figures/figure3-{elements}-seed{seed}.png",
            "comparison",
            "Comparisons",
            figure="lenses",
            elements="{elements}",
            seed="{seed}",
        ),
        figure_svg="results/{study}/figures/figure3-{elements}-seed{seed}.svg",
        figure_pdf="results/{study}/figures/figure3-{elements}-seed{seed}.pdf",
    log:
        "results/{study}/logs/comparison/{elements}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/comparison/{elements}-seed{seed}.tsv"
    resources:
        **needs("comparison"),
    params:
        **call("tasklens.study.jobs.lens_figures.compare"),
        settings=settings(paper_claims.comparison),
    script:
        "../scripts/job.py"


rule frames:
    """Draw frames, a chart and test images, through the task-driven lenses and the best imaging lens (figure 4)."""
    input:
        lenses=files_of(rules.design.output.lens, paper_claims.comparison),
        psfs=files_of(rules.psfs.output.psf, paper_claims.comparison),
        metrics=files_of(rules.fine_tune.output.metrics, paper_claims.comparison, "baseline_keys"),
        test=TEST,
        correct=files_of(rules.fine_tune.output.predictions, paper_claims.comparison, "measured_keys"),
    output:
        figure=report_output(
            "results/{study}/figures/figure4-{elements}-seed{seed}.png",
            "frames",
            "Comparisons",
            figure="frames",
            elements="{elements}",
            seed="{seed}",
        ),
    log:
        "results/{study}/logs/frames/{elements}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/frames/{elements}-seed{seed}.tsv"
    resources:
        **needs("frames"),
    params:
        **call("tasklens.study.jobs.frames.run"),
        settings=settings(report_jobs.FramesJob.of),
    script:
        "../scripts/job.py"


rule captures:
    """Simulate captures of some test images through every lens of the first seed; classify them with each network."""
    input:
        test=lambda w: [path_of(pattern, whole_study_of(w)) for pattern in TEST],
        psfs=files_of(rules.psfs.output.psf, report_jobs.CapturesJob.of),
        restorations=files_of(rules.restore.output.weights, report_jobs.CapturesJob.of, "restored_keys"),
        weights=files_of(rules.fine_tune.output.weights, report_jobs.CapturesJob.of, "measured_keys"),
        correct=files_of(rules.fine_tune.output.predictions, report_jobs.CapturesJob.of, "supervised_keys"),
    output:
        images="results/{study}/figures/captures.safetensors",
        answers="results/{study}/tables/answers.csv",
    log:
        "results/{study}/logs/captures.log",
    benchmark:
        "results/{study}/benchmarks/captures.tsv"
    priority: early()
    resources:
        **needs("captures", gpu=1),
    params:
        **call("tasklens.study.jobs.capture.run"),
        settings=settings(report_jobs.CapturesJob.of),
    script:
        "../scripts/job.py"
