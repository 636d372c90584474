def table_inputs(wildcards):
    """The lenses of a table, and the metrics of its classifiers on them and on the pictures themselves."""
    job = jobs.table(study, wildcards.table)
    seen = restored if job.name == "table4" else str
    return {
        "lenses": [layout.lens(lens, seed) for lens in job.lenses for seed in job.seeds],
        "metrics": [
            layout.metrics(lens, seed, seen(classifier))
            for lens in job.lenses
            for seed in job.seeds
            for classifier in job.classifiers
        ],
        "reference": [layout.metrics(SHARP, seed, classifier) for seed in job.seeds for classifier in job.classifiers],
    }


rule table:
    input:
        unpack(table_inputs),
        paper=PAPER,
    output:
        multiext(f"{layout.root}/tables/{{table}}", ".csv", ".md", ".tex", ".json"),
    log:
        f"{layout.root}/logs/{{table}}.log",
    threads: 1
    params:
        job=lambda wildcards: jobs.table(study, wildcards.table).model_dump_json(),
        code=code("table"),
    shell:
        "{TASKLENS} table {layout.study} {wildcards.table} 2> {log}"


rule figure:
    input:
        lens=layout.lens("{lens}", "{seed}"),
        psf=layout.psf("{lens}", "{seed}"),
    output:
        layout.figure("{lens}", "{seed}"),
    log:
        f"{layout.root}/logs/figure/{{lens}}-seed{{seed}}.log",
    threads: 1
    params:
        job=jobs.psf(study).model_dump_json(),
        code=code("figure"),
    shell:
        "{TASKLENS} figure {layout.study} {wildcards.lens} --seed {wildcards.seed} 2> {log}"
