"""One rule for every stage; inputs, outputs and settings of jobs are declared in `tasklens.pipeline.jobs`."""

@cache
def plan(name, *wildcards):
    """Return the plan of a job, made once: it may list a folder of a million photographs."""
    return STAGES[name].plan_from(study, dict(wildcards))


for stage in STAGES.values():  # functions of wildcards are called later: each keeps its own stage
    if callable(stage.patterns) and not stage.outputs(study):
        continue

    rule:
        name:
            stage.name
        input:
            unpack(lambda w, stage=stage: {"files": [*map(str, flatten(plan(stage.name, *w.items()).inputs))]}),
        output:
            **stage.outputs(study),
        log:
            f"{results(study)}/logs/{stage.label}.log",
        benchmark:
            stage.benchmark(study)
        priority: stage.priority
        retries: int(stage.resumable)
        localrule: not stage.patterns  # it prints
        threads: lambda w, stage=stage: stage.threads * plan(stage.name, *w.items()).processes
        resources:
            mem_mb=lambda w, attempt, stage=stage: attempt * durations.memory_mb(stage.name),
            runtime=lambda w, attempt, stage=stage: attempt * durations.limit_minutes(stage.name),
            gpu=lambda w, stage=stage: plan(stage.name, *w.items()).gpus,
        params:
            settings=lambda w, stage=stage: plan(stage.name, *w.items()).settings.model_dump_json(),
            command=lambda w, stage=stage: stage.command(study, w, RESOLVED),
            code=code_digest(stage.function),
        shell:
            "{params.command} 2> {log}"
