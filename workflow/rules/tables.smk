"""Tables, verdicts, the page, and verification."""


rule table:
    """Make one table of the paper as CSV, Markdown and LaTeX."""
    input:
        lenses=lambda w: paths_of(rules.design.output.lens, whole_study_of(w), table_of(w).lens_keys),
        metrics=lambda w: paths_of(rules.fine_tune.output.metrics, whole_study_of(w), table_of(w).measured_keys),
        frozen=lambda w: paths_of(rules.fine_tune.output.frozen, whole_study_of(w), table_of(w).frozen_keys),
    output:
        csv=report(
            "results/{study}/tables/{table}.csv",
            caption="../report/table.rst",
            category="Tables",
            labels={"study": "{study}", "table": "{table}"},
        ),
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
        settings=settings(lambda study, table: paper_tables.table(study, table)),
    script:
        "../scripts/job.py"


rule verdicts_table:
    """Make the table of verdicts on the paper's claims from the measured accuracies."""
    input:
        **compared(lambda w: paper_claims.claims(study_of(w))),
    output:
        csv=report(
            "results/{study}/tables/verdicts.csv",
            caption="../report/verdicts.rst",
            category="Tables",
            labels={"study": "{study}", "table": "verdicts"},
        ),
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
        **compared(lambda w: paper_claims.ablation_claims(study_of(w), w.ablation).claims),
    output:
        csv=report(
            "results/{study}/tables/ablation_{ablation}.csv",
            caption="../report/ablation.rst",
            category="Tables",
            labels={"study": "{study}", "table": "ablation {ablation}"},
        ),
        md="results/{study}/tables/ablation_{ablation}.md",
        answers="results/{study}/tables/ablation_{ablation}.npz",
    log:
        "results/{study}/logs/ablation/{ablation}.log",
    benchmark:
        "results/{study}/benchmarks/ablation/{ablation}.tsv"
    resources:
        **needs("ablation"),
    params:
        **call("tasklens.study.report.ablations.make"),
        settings=settings(lambda study, ablation: paper_claims.ablation_claims(study, ablation)),
    script:
        "../scripts/job.py"


rule psf_tail_table:
    """Make the tables of core, tail and encircled energy of all PSFs."""
    input:
        lenses=lambda w: paths_of(
            rules.design.output.lens, whole_study_of(w), report_jobs.TailsJob.of(study_of(w)).lens_keys
        ),
    output:
        csv=report(
            "results/{study}/tables/psf_tail.csv",
            caption="../report/psf_tail.rst",
            category="Tables",
            labels={"study": "{study}", "table": "tails of PSFs"},
        ),
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
        lenses=lambda w: paths_of(
            rules.design.output.lens, whole_study_of(w), paper_effort.effort(study_of(w)).lens_keys
        ),
    output:
        csv=report(
            "results/{study}/effort.csv",
            caption="../report/effort.rst",
            category="Tables",
            labels={"study": "{study}", "table": "effort"},
        ),
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
        **call("tasklens.study.report.effort.make"),
        settings=settings(paper_effort.effort),
        unawaited=design_benchmarks,
    script:
        "../scripts/job.py"


rule ranking_table:
    """Rank lenses by the accuracy of the supervisor: a table, and a page."""
    input:
        lenses=lambda w: paths_of(rules.design.output.lens, study_of(w), ranking_of(w).lens_keys),
        metrics=lambda w: paths_of(rules.fine_tune.output.metrics, study_of(w), ranking_of(w).measured_keys),
        predicted=lambda w: paths_of(rules.fine_tune.output.predictions, study_of(w), ranking_of(w).measured_keys),
        built=lambda w: paths_of(rules.production.output.lenses, study_of(w), ranking_of(w).built_keys),
    output:
        csv=report(
            "results/{study}/tables/ranking.csv",
            caption="../report/ranking.rst",
            category="Tables",
            labels={"study": "{study}", "table": "ranking"},
        ),
        md="results/{study}/tables/ranking.md",
        page="results/{study}/ranking.html",
    log:
        "results/{study}/logs/ranking_table.log",
    benchmark:
        "results/{study}/benchmarks/ranking_table.tsv"
    resources:
        **needs("ranking_table"),
    params:
        **call("tasklens.study.report.ranking.make"),
        settings=settings(RankingJob.of),
    script:
        "../scripts/job.py"


rule merit_function_table:
    """Make the table and figure of the loss of each classifier as a function of the MTF."""
    input:
        psfs=lambda w: psf_files(study_of(w), report_jobs.MeritFunctionJob.of(study_of(w)).contents.lens_keys),
        frozen=lambda w: paths_of(
            rules.fine_tune.output.frozen, study_of(w), report_jobs.MeritFunctionJob.of(study_of(w)).frozen_keys
        ),
    output:
        csv=report(
            "results/{study}/tables/merit_function.csv",
            caption="../report/merit_function.rst",
            category="Merit function",
            labels={"study": "{study}", "result": "table"},
        ),
        md="results/{study}/tables/merit_function.md",
        figure=report(
            "results/{study}/figures/merit_function.png",
            caption="../report/merit_function.rst",
            category="Merit function",
            labels={"study": "{study}", "result": "figure"},
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
        lenses=shown(rules.design.output.lens),
        histories=shown(rules.design.output.history),
        pages=shown(rules.certificate.output.page),
        zemax=shown(rules.certificate.output.zemax),
        catalogues=shown(rules.certificate.output.catalogue),
        sections=shown(rules.certificate.output.section),
        spots=shown(rules.certificate.output.spots),
        psfs=shown(rules.certificate.output.psfs),
        curves=shown(rules.certificate.output.curves),
        restorations=lambda w: paths_of(
            rules.restore.output.history, whole_study_of(w), report_jobs.ReportJob.of(study_of(w)).restored_keys
        ),
        capture_file=rules.captures.output.images,
        answers=rules.captures.output.answers,
    output:
        report=report(
            "results/{study}/report.html",
            caption="../report/report.rst",
            category="Page",
            labels={"study": "{study}", "result": "page"},
        ),
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
        **call("tasklens.study.report.sweep.make"),
        settings=settings(report_jobs.SweepJob.of),
    script:
        "../scripts/job.py"


rule verify:
    """Verify limits and accuracies of the finished study of the configuration; print failures and verdicts."""
    input:
        lenses=lambda w: paths_of(rules.design.output.lens, STUDY, verification(w).lens_keys),
        metrics=lambda w: paths_of(rules.fine_tune.output.metrics, STUDY, verification(w).measured_keys),
        predictions=lambda w: paths_of(rules.fine_tune.output.predictions, STUDY, verification(w).measured_keys),
        reproduced=lambda w: paths_of(rules.reproduce.output.predictions, STUDY, verification(w).measured_keys),
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
        settings=settings(paper_tables.verification),
    script:
        "../scripts/job.py"
