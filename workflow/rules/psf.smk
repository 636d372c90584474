rule psf:
    input:
        layout.lens("{lens}", "{seed}"),
    output:
        layout.psf("{lens}", "{seed}"),
    log:
        f"{layout.root}/logs/psf/{{lens}}-seed{{seed}}.log",
    threads: 1
    params:
        study=layout.study,
        job=lambda wildcards: jobs.psf(study, wildcards.lens).model_dump_json(),
        code=code("psf"),
    shell:
        "tasklens psf {params.study} {wildcards.lens} --seed {wildcards.seed} 2> {log}"


rule tail:
    input:
        layout.lens("{lens}", "{seed}"),
    output:
        layout.tail("{lens}", "{seed}"),
        layout.encircled_energy("{lens}", "{seed}"),
    log:
        f"{layout.root}/logs/tail/{{lens}}-seed{{seed}}.log",
    threads: 1
    params:
        study=layout.study,
        job=lambda wildcards: jobs.psf(study, wildcards.lens).model_dump_json(),
        code=code("tail"),
    shell:
        "tasklens tail {params.study} {wildcards.lens} --seed {wildcards.seed} 2> {log}"


rule certificate:
    input:
        layout.lens("{lens}", "{seed}"),
    output:
        layout.certificate("{lens}", "{seed}"),
    log:
        f"{layout.root}/logs/certificate/{{lens}}-seed{{seed}}.log",
    threads: 1
    params:
        study=layout.study,
        code=code("certificate"),
    shell:
        "tasklens certificate {params.study} {wildcards.lens} --seed {wildcards.seed} 2> {log}"
