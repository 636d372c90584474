rule reproduce:
    input:
        pictures=layout.images("test"),
        weights=layout.classifier("{lens}", "{seed}", "{classifier}"),
        psf=seen_through,
    output:
        layout.reproduced("{lens}", "{seed}", "{classifier}"),
    log:
        f"{layout.root}/logs/reproduce/{{lens}}-seed{{seed}}-{{classifier}}.log",
    threads: 1
    params:
        study=layout.study,
        job=lambda wildcards: jobs.reproduce(study, wildcards.lens, wildcards.classifier, False).model_dump_json(),
        code=code("reproduce"),
    shell:
        "tasklens reproduce {params.study} {wildcards.lens} {wildcards.classifier} --seed {wildcards.seed} 2> {log}"


rule reproduce_restored:
    input:
        pictures=layout.images("test"),
        weights=layout.classifier("{lens}", "{seed}", restored("{classifier}")),
        psf=layout.psf("{lens}", "{seed}"),
        restoration=layout.restoration("{lens}", "{seed}"),
    output:
        layout.reproduced("{lens}", "{seed}", restored("{classifier}")),
    log:
        f"{layout.root}/logs/reproduce_restored/{{lens}}-seed{{seed}}-{{classifier}}.log",
    threads: 1
    params:
        study=layout.study,
        job=lambda wildcards: jobs.reproduce(study, wildcards.lens, wildcards.classifier, True).model_dump_json(),
        code=code("reproduce"),
    shell:
        "tasklens reproduce {params.study} {wildcards.lens} {wildcards.classifier} --restored"
        " --seed {wildcards.seed} 2> {log}"


rule verify:  # it makes no file: asked for again, it looks again
    input:
        unpack(measured),
        reproduced=[
            layout.reproduced(lens, seed, classifier) for lens, classifier in VERIFIED.measured for seed in study.seeds
        ],
        tables=[layout.table(table.name, "csv") for table in VERIFIED.tables],
        verdicts=layout.table("verdicts", "md"),
    log:
        f"{layout.root}/logs/verify.log",
    localrule: True
    threads: 1
    params:
        study=layout.study,
    shell:
        "tasklens verify {params.study} 2> {log}"
