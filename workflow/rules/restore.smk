rule restore:
    input:
        pictures=[layout.images(split) for split in ("train", "minival")],
        psf=layout.psf("{lens}", "{seed}"),
    output:
        layout.restoration("{lens}", "{seed}"),
        layout.restoration_history("{lens}", "{seed}"),
    log:
        f"{layout.root}/logs/restore/{{lens}}-seed{{seed}}.log",
    priority: 1  # of the jobs that can run, the one that another, as long, waits for
    threads: 1
    params:
        study=layout.study,
        job=lambda wildcards: jobs.restore(study, wildcards.lens, wildcards.seed).model_dump_json(),
        code=code("restore"),
    shell:
        "tasklens restore {params.study} {wildcards.lens} --seed {wildcards.seed} 2> {log}"


rule fine_tune_restored:
    input:
        pictures=PICTURES,
        weights=layout.reference("{classifier}"),
        psf=layout.psf("{lens}", "{seed}"),
        restoration=layout.restoration("{lens}", "{seed}"),
    output:
        weights=layout.classifier("{lens}", "{seed}", restored("{classifier}")),
        metrics=layout.metrics("{lens}", "{seed}", restored("{classifier}")),
        pictures=layout.pictures("{lens}", "{seed}", restored("{classifier}")),
    log:
        f"{layout.root}/logs/fine_tune_restored/{{lens}}-seed{{seed}}-{{classifier}}.log",
    threads: processes
    params:
        tasklens=tasklens_of,
        study=layout.study,
        job=lambda wildcards: jobs.fine_tune(
            study, wildcards.lens, wildcards.classifier, wildcards.seed, True
        ).model_dump_json(),
        code=code("fine_tune"),
    shell:
        "{params.tasklens} fine-tune {params.study} {wildcards.lens} {wildcards.classifier} --restored"
        " --seed {wildcards.seed} 2> {log}"
