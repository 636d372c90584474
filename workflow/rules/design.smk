rule design:
    input:
        unpack(design_inputs),
    output:
        lens=layout.lens("{lens}", "{seed}"),
        history=layout.history("{lens}", "{seed}"),
    log:
        f"{layout.root}/logs/design/{{lens}}-seed{{seed}}.log",
    priority: 1  # most waits for designs, and the longest jobs are among them
    threads: 1
    params:
        study=layout.study,
        job=lambda wildcards: jobs.design(study, wildcards.lens, wildcards.seed).model_dump_json(),
        code=code("design"),
    shell:
        "tasklens design {params.study} {wildcards.lens} --seed {wildcards.seed} 2> {log}"
