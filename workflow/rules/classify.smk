rule reference:
    input:
        pictures=layout.images("train"),
        weights=published_weights,
    output:
        layout.reference("{classifier}"),
    log:
        f"{layout.root}/logs/reference/{{classifier}}.log",
    threads: 1
    params:
        study=layout.study,
        job=lambda wildcards: jobs.reference(study, wildcards.classifier).model_dump_json(),
        code=code("reference"),
    shell:
        "tasklens reference {params.study} {wildcards.classifier} 2> {log}"


rule fine_tune:
    input:
        pictures=PICTURES,
        weights=layout.reference("{classifier}"),
        psf=seen_through,
    output:
        weights=layout.classifier("{lens}", "{seed}", "{classifier}"),
        metrics=layout.metrics("{lens}", "{seed}", "{classifier}"),
        pictures=layout.pictures("{lens}", "{seed}", "{classifier}"),
    log:
        f"{layout.root}/logs/fine_tune/{{lens}}-seed{{seed}}-{{classifier}}.log",
    threads: processes
    params:
        tasklens=tasklens_of,
        study=layout.study,
        job=lambda wildcards: jobs.fine_tune(
            study, wildcards.lens, wildcards.classifier, wildcards.seed, False
        ).model_dump_json(),
        code=code("fine_tune"),
    shell:
        "{params.tasklens} fine-tune {params.study} {wildcards.lens} {wildcards.classifier} --seed {wildcards.seed}"
        " 2> {log}"
