def design_inputs(wildcards):
    """What a design reads: nothing, or pictures and the supervisor, or also the imaging lenses to start from."""
    inputs = {}
    job = jobs.design(study, wildcards.lens, wildcards.seed)
    if job.classifier is not None:
        inputs["pictures"] = layout.images("train")
        inputs["weights"] = layout.reference(study.supervisor)
    rivals = jobs.imaging_rivals(study, wildcards.lens)
    if rivals:
        inputs["rivals"] = [layout.lens(name, wildcards.seed) for name in rivals]
        inputs["judged"] = [layout.metrics(name, wildcards.seed, study.supervisor) for name in rivals]
    return inputs


rule design:
    input:
        unpack(design_inputs),
    output:
        lens=layout.lens("{lens}", "{seed}"),
        history=layout.history("{lens}", "{seed}"),
    log:
        f"{layout.root}/logs/design/{{lens}}-seed{{seed}}.log",
    threads: 1
    params:
        job=lambda wildcards: jobs.design(study, wildcards.lens, wildcards.seed).model_dump_json(),
        code=code("design"),
    shell:
        "{TASKLENS} design {layout.study} {wildcards.lens} --seed {wildcards.seed} 2> {log}"
