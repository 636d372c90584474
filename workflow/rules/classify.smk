PICTURES = [layout.images(split) for split in ("train", "minival", "test")]


def published_weights(wildcards):
    """The local file that a classifier starts from, if its study names one."""
    path = study.classifiers[wildcards.classifier].weights
    return [] if path is None else str(path)


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
        job=lambda wildcards: jobs.reference(study, wildcards.classifier).model_dump_json(),
        code=code("reference"),
    shell:
        "{TASKLENS} reference {layout.study} {wildcards.classifier} 2> {log}"


def seen_through(wildcards):
    """The PSF grid of a lens; nothing for a classifier that sees the pictures themselves."""
    return [] if wildcards.lens == SHARP else layout.psf(wildcards.lens, wildcards.seed)


rule fine_tune:
    input:
        pictures=PICTURES,
        weights=layout.reference("{classifier}"),
        psf=seen_through,
    output:
        weights=layout.classifier("{lens}", "{seed}", "{classifier}"),
        metrics=layout.metrics("{lens}", "{seed}", "{classifier}"),
    log:
        f"{layout.root}/logs/fine_tune/{{lens}}-seed{{seed}}-{{classifier}}.log",
    threads: 1
    params:
        job=lambda wildcards: jobs.fine_tune(
            study, wildcards.lens, wildcards.classifier, wildcards.seed, False
        ).model_dump_json(),
        code=code("fine_tune"),
    shell:
        "{TASKLENS} fine-tune {layout.study} {wildcards.lens} {wildcards.classifier} --seed {wildcards.seed} 2> {log}"
