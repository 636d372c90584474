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
        study=layout.study,
        job=lambda wildcards: jobs.table(study, wildcards.table).model_dump_json(),
        code=code("table"),
    shell:
        "tasklens table {params.study} {wildcards.table} 2> {log}"


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
        study=layout.study,
        job=jobs.psf(study).model_dump_json(),
        code=code("figure"),
    shell:
        "tasklens figure {params.study} {wildcards.lens} --seed {wildcards.seed} 2> {log}"
