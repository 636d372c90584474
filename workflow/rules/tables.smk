"""Tables, verdicts, the page, and verification."""


rule table:
    """Make one table of the paper as CSV, Markdown and LaTeX."""
    input:
        lenses=files_of(rules.design.output.lens, table_of),
        metrics=files_of(rules.fine_tune.output.metrics, table_of, "measured_keys"),
        frozen=files_of(rules.fine_tune.output.frozen, table_of, "frozen_keys"),
    output:
        csv=report_output("results/{study}/tables/{table}.csv", "table", table="{table}"),
        md="results/{study}/tables/{table}.md",
        tex="results/{study}/tables/{table}.tex",
        seeds_csv="results/{study}/tables/{table}.seeds.csv",
        json="results/{study}/tables/{table}.json",
    log:
        "results/{study}/logs/table/{table}.log",
    benchmark:
        "results/{study}/benchmarks/table/{table}.tsv"
    priority: early()
    resources:
        **needs("table"),
    params:
        **call("tasklens.study.report.tables.make"),
        settings=settings(table_of),
    script:
        "../scripts/job.py"


rule verdicts_table:
    """Make the table of verdicts on the paper's claims from the measured accuracies."""
    input:
        **claim_inputs(paper_claims.claims),
    output:
        csv=report_output("results/{study}/tables/verdicts.csv", "verdicts", table="verdicts"),
        md="results/{study}/tables/verdicts.md",
        answers="results/{study}/tables/verdicts.npz",
    log:
        "results/{study}/logs/verdicts_table.log",
    benchmark:
        "results/{study}/benchmarks/verdicts_table.tsv"
    priority: early()
    resources:
        **needs("verdicts_table"),
    params:
        **call("tasklens.study.report.verdicts.make"),
        settings=settings(paper_claims.claims),
    script:
        "../scripts/job.py"


rule ablation:
    """Make the table of one ablation: a design and its variants."""
    input:
        **claim_inputs(paper_claims.ablation_claims),
    output:
        csv=report_output("results/{study}/tables/ablation_{ablation}.csv", "ablation", table="ablation {ablation}"),
        md="results/{study}/tables/ablation_{ablation}.md",
        answers="results/{study}/tables/ablation_{ablation}.npz",
    log:
        "results/{study}/logs/ablation/{ablation}.log",
    benchmark:
        "results/{study}/benchmarks/ablation/{ablation}.tsv"
    resources:
        **needs("ablation"),
    params:
        **call("tasklens.study.report.ablation_table.make"),
        settings=settings(paper_claims.ablation_claims),
    script:
        "../scripts/job.py"


rule psf_tail_table:
    """Make the tables of core, tail and encircled energy of all PSFs."""
    input:
        lenses=files_of(rules.design.output.lens, report_jobs.TailsJob.of),
    output:
        csv=report_output("results/{study}/tables/psf_tail.csv", "psf_tail", table="tails of PSFs"),
        md="results/{study}/tables/psf_tail.md",
        fields_csv="results/{study}/tables/psf_tail.fields.csv",
        encircled_energy="results/{study}/tables/encircled_energy.csv",
    log:
        "results/{study}/logs/psf_tail_table.log",
    benchmark:
        "results/{study}/benchmarks/psf_tail_table.tsv"
    priority: early()
    resources:
        **needs("psf_tail_table"),
    params:
        **call("tasklens.study.jobs.psf_tail.run"),
        settings=settings(report_jobs.TailsJob.of),
    script:
        "../scripts/job.py"


rule effort_table:
    """Make the table of the effort of each design: lens evaluations, and wall times, which differ from run to run."""
    input:
        lenses=files_of(rules.design.output.lens, paper_effort.effort),
    output:
        csv=report_output("results/{study}/effort.csv", "effort", table="effort"),
        md="results/{study}/effort.md",
    log:
        "results/{study}/logs/effort_table.log",
    benchmark:
        "results/{study}/benchmarks/effort_table.tsv"
    priority: early()
    localrule: True
    resources:
        **needs("effort_table"),
    params:
        **call("tasklens.study.report.effort_table.make"),
        settings=settings(paper_effort.effort),
        unawaited=design_benchmarks,
    script:
        "../scripts/job.py"


rule ranking_table:
    """Rank lenses by the accuracy of the supervisor: a table, and a page."""
    input:
        lenses=files_of(rules.design.output.lens, report_jobs.RankingJob.of),
        metrics=files_of(rules.fine_tune.output.metrics, report_jobs.RankingJob.of, "measured_keys"),
        predicted=files_of(rules.fine_tune.output.predictions, report_jobs.RankingJob.of, "measured_keys"),
        built=files_of(rules.production.output.lenses, report_jobs.RankingJob.of, "built_keys"),
    output:
        csv=report_output("results/{study}/tables/ranking.csv", "ranking", table="ranking"),
        md="results/{study}/tables/ranking.md",
        page="results/{study}/ranking.html",
    log:
        "results/{study}/logs/ranking_table.log",
    benchmark:
        "results/{study}/benchmarks/ranking_table.tsv"
    resources:
        **needs("ranking_table"),
    params:
        **call("tasklens.study.report.ranking_table.make"),
        settings=settings(report_jobs.RankingJob.of),
    script:
        "../scripts/job.py"


rule merit_function_table:
    """Make the table and figure of the loss of each classifier as a function of the MTF."""
    input:
        psfs=files_of(rules.psfs.output.psf, report_jobs.MeritFunctionJob.of),
        frozen=files_of(rules.fine_tune.output.frozen, report_jobs.MeritFunctionJob.of, "frozen_keys"),
    output:
        csv=report_output(
            "results/{study}/tables/merit_function.csv", "merit_function", "Merit function", result="table"
        ),
        md="results/{study}/tables/merit_function.md",
        figure=report_output(
            "results/{study}/figures/merit_function.png", "merit_function", "Merit function", result="figure"
        ),
    log:
        "results/{study}/logs/merit_function_table.log",
    benchmark:
        "results/{study}/benchmarks/merit_function_table.tsv"
    resources:
        **needs("merit_function_table"),
    params:
        **call("tasklens.study.report.merit_function.make"),
        settings=settings(report_jobs.MeritFunctionJob.of),
    script:
        "../scripts/job.py"


rule report_page:
    """Make the page that shows the results of a study, from its tables, drawings, captures and benchmarks."""
    input:
        table_files=tables_of(rules.table.output.csv),
        seeds_files=tables_of(rules.table.output.seeds_csv),
        provenance=tables_of(rules.table.output.json),
        verdicts=rules.verdicts_table.output.csv,
        psf_tail=rules.psf_tail_table.output.csv,
        effort=rules.effort_table.output.csv,
        lenses=files_of(rules.design.output.lens, report_jobs.ReportJob.of),
        histories=files_of(rules.design.output.history, report_jobs.ReportJob.of),
        pages=files_of(rules.certificate.output.page, report_jobs.ReportJob.of),
        zemax=files_of(rules.certificate.output.zemax, report_jobs.ReportJob.of),
        catalogues=files_of(rules.certificate.output.catalogue, report_jobs.ReportJob.of),
        sections=files_of(rules.certificate.output.section, report_jobs.ReportJob.of),
        spots=files_of(rules.certificate.output.spots, report_jobs.ReportJob.of),
        psfs=files_of(rules.certificate.output.psfs, report_jobs.ReportJob.of),
        curves=files_of(rules.certificate.output.curves, report_jobs.ReportJob.of),
        restorations=files_of(rules.restore.output.history, report_jobs.ReportJob.of, "restored_keys"),
        capture_file=rules.captures.output.images,
        answers=rules.captures.output.answers,
    output:
        report=report_output("results/{study}/report.html", "report", "Page", result="page"),
        answer="results/{study}/answer.svg",
    log:
        "results/{study}/logs/report_page.log",
    benchmark:
        "results/{study}/benchmarks/report_page.tsv"
    priority: page_priority
    resources:
        **needs("report_page"),
    params:
        **call("tasklens.study.report.page.assembly.make"),
        settings=settings(report_jobs.ReportJob.of),
        unawaited=optional_files,
    script:
        "../scripts/job.py"


rule sweep_table:
    """Make the table of a sweep: the numbers of all points side by side."""
    input:
        tables=tables_of_points,
    output:
        csv="results/{study}/sweep.csv",
        md="results/{study}/sweep.md",
    log:
        "results/{study}/logs/sweep_table.log",
    benchmark:
        "results/{study}/benchmarks/sweep_table.tsv"
    localrule: True
    resources:
        **needs("sweep_table"),
    params:
        **call("tasklens.study.report.sweep_table.make"),
        settings=settings(report_jobs.SweepJob.of),
    script:
        "../scripts/job.py"


rule verify:
    """Verify limits and accuracies of the finished study of the configuration; print failures and verdicts."""
    input:
        lenses=files_of(rules.design.output.lens, verification),
        metrics=files_of(rules.fine_tune.output.metrics, verification, "measured_keys"),
        predictions=files_of(rules.fine_tune.output.predictions, verification, "measured_keys"),
        reproduced=files_of(rules.reproduce.output.predictions, verification, "measured_keys"),
        tables=tables_of(rules.table.output.csv),
        verdicts=lambda _: path_of(rules.verdicts_table.output.md, STUDY),
    log:
        f"results/{STUDY.name}/logs/verify.log",
    benchmark:
        f"results/{STUDY.name}/benchmarks/verify.tsv"
    retries: 0
    localrule: True
    resources:
        **needs("verify"),
    params:
        **call("tasklens.study.report.verification.run"),
        settings=settings(verification),
    script:
        "../scripts/job.py"
