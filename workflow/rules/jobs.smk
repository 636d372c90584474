"""One rule for every stage; inputs, outputs and settings of jobs are declared in `tasklens.pipeline.jobs`."""

for stage in STAGES.values():  # functions of wildcards are called later: each keeps its own stage

    rule:
        name:
            stage.name
        input:
            unpack(lambda w, stage=stage: {"files": [*map(str, flatten(stage.plan_from(study, w).inputs))]}),
        output:
            **stage.outputs(study),
        log:
            f"{results(study)}/logs/{stage.label}.log",
        benchmark:
            f"{results(study)}/benchmarks/{stage.label}.tsv"
        priority: stage.priority
        retries: int(stage.resumable)
        localrule: not stage.patterns  # it prints
        threads: lambda w, stage=stage: stage.threads * stage.plan_from(study, w).processes
        resources:
            mem_mb=lambda w, attempt, stage=stage: attempt * durations.memory_mb(stage.name),
            runtime=durations.limit_minutes(stage.name),
            gpu=lambda w, stage=stage: stage.plan_from(study, w).gpus,
        params:
            settings=lambda w, stage=stage: stage.plan_from(study, w).settings.model_dump_json(),
            command=lambda w, stage=stage: stage.command(study, w, RESOLVED),
            code=code_digest(stage.function),
        shell:
            "{params.command} 2> {log}"
