"""Lenses built in simulation, with manufacturing errors."""


rule production:
    """Build lenses of a design in simulation, with manufacturing errors, and measure them."""
    input:
        lens=rules.design.output.lens,
        weights=supervisor_weights,
        minival=MINIVAL,
        test=TEST,
    output:
        lenses="results/{study}/lenses/{lens}/seed{seed}/built_lenses.csv",
        error_table="results/{study}/lenses/{lens}/seed{seed}/errors.csv",
        page="results/{study}/lenses/{lens}/seed{seed}/tolerances.md",
    log:
        "results/{study}/logs/production/{lens}-seed{seed}.log",
    benchmark:
        "results/{study}/benchmarks/production/{lens}-seed{seed}.tsv"
    resources:
        **needs("production", gpu=1),
    params:
        **call("tasklens.study.jobs.produce.run"),
        settings=settings(built_lenses.ProductionJob.of),
    script:
        "../scripts/job.py"


rule tolerances_table:
    """Make the table of built lenses: loss of accuracy in manufacture, compared with imaging lenses."""
    input:
        built_lenses=files_of(rules.production.output.lenses, built_lenses.built_contents),
    output:
        csv=report_output("results/{study}/tables/tolerances.csv", "tolerances", table="built lenses"),
        md="results/{study}/tables/tolerances.md",
        compared_csv=report_output(
            "results/{study}/tables/tolerances.compared.csv", "tolerances", table="built lenses, compared"
        ),
    log:
        "results/{study}/logs/tolerances_table.log",
    benchmark:
        "results/{study}/benchmarks/tolerances_table.tsv"
    resources:
        **needs("tolerances_table"),
    params:
        **call("tasklens.study.report.tolerances.make"),
        settings=settings(built_lenses.built_contents),
    script:
        "../scripts/job.py"
