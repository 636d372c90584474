rule table:
    input:
        unpack(table_inputs),
        paper=PAPER,
    output:
        multiext(f"{layout.root}/tables/{{table}}", ".csv", ".seeds.csv", ".md", ".tex", ".json"),
    log:
        f"{layout.root}/logs/{{table}}.log",
    threads: 1
    params:
        study=layout.study,
        job=lambda wildcards: jobs.table(study, wildcards.table).model_dump_json(),
        code=code("table"),
    shell:
        "tasklens table {params.study} {wildcards.table} 2> {log}"


rule psf_tail:
    input:
        [layout.tail(lens, seed) for lens in jobs.shown(study) for seed in study.seeds],
        [layout.encircled_energy(lens, seed) for lens in jobs.shown(study) for seed in study.seeds],
    output:
        layout.table("psf_tail", "csv"),
        layout.table("psf_tail", "md"),
        layout.table("encircled_energy", "csv"),
    log:
        f"{layout.root}/logs/psf_tail.log",
    threads: 1
    params:
        study=layout.study,
        job=jobs.psf_tail(study).model_dump_json(),
        code=code("psf_tail"),
    shell:
        "tasklens psf-tail {params.study} 2> {log}"


rule verdicts:
    input:
        unpack(measured),
    output:
        layout.table("verdicts", "csv"),
        layout.table("verdicts", "md"),
    log:
        f"{layout.root}/logs/verdicts.log",
    threads: 1
    params:
        study=layout.study,
        job=claims.verdicts(study).model_dump_json(),
        code=code("verdicts"),
    shell:
        "tasklens verdicts {params.study} 2> {log}"


rule regimes:
    input:
        unpack(lambda wildcards: opposed(claims.regimes(study))),
    output:
        layout.table("regimes", "csv"),
        layout.table("regimes", "md"),
    log:
        f"{layout.root}/logs/regimes.log",
    threads: 1
    params:
        study=layout.study,
        job=claims.regimes(study).model_dump_json(),
        code=code("regimes"),
    shell:
        "tasklens regimes {params.study} 2> {log}"


rule ablation:
    input:
        unpack(varied),
    output:
        layout.ablation("{ablation}", "csv"),
        layout.ablation("{ablation}", "md"),
    log:
        f"{layout.root}/logs/ablation_{{ablation}}.log",
    threads: 1
    params:
        study=layout.study,
        job=lambda wildcards: claims.ablation(study, wildcards.ablation).model_dump_json(),
        code=code("ablation"),
    shell:
        "tasklens ablation {params.study} {wildcards.ablation} 2> {log}"


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
        code=code("figure"),
    shell:
        "tasklens figure {params.study} {wildcards.lens} --seed {wildcards.seed} 2> {log}"


rule comparison:
    input:
        unpack(beside),
    output:
        layout.comparison("{elements}", "{seed}"),
    log:
        f"{layout.root}/logs/comparison/{{elements}}-seed{{seed}}.log",
    threads: 1
    params:
        study=layout.study,
        job=lambda wildcards: claims.over_imaging(study, wildcards.elements).model_dump_json(),
        code=code("comparison"),
    shell:
        "tasklens comparison {params.study} {wildcards.elements} --seed {wildcards.seed} 2> {log}"
