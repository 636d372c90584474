"""One rule for every stage; inputs, outputs and settings of jobs are declared in `tasklens.pipeline.jobs`."""


def plan_of(stage, wildcards):
    """Return the plan of the job with these wildcards."""
    named = {name: wildcards[name] for name in stage.wildcards}
    return stage.plan(study, **(named | ({SEED: int(named[SEED])} if SEED in named else {})))


def command(stage, wildcards):
    """Return the command line of a job."""
    processes = plan_of(stage, wildcards).processes
    # Snakemake sets OMP_NUM_THREADS to the cores of a job, which here are those of all its processes.
    together = f"OMP_NUM_THREADS=1 torchrun --standalone --nproc-per-node {processes} -m tasklens.pipeline.cli"
    words = [wildcards[name] for name in stage.wildcards if name != SEED]
    seed = ["--seed", wildcards[SEED]] if SEED in stage.wildcards else []
    return " ".join(["tasklens" if processes == 1 else together, stage.name.replace("_", "-"), RESOLVED, *words, *seed])


for stage in STAGES.values():  # functions of wildcards are called later, so each binds its stage as a default argument

    rule:
        name:
            stage.name
        input:
            unpack(lambda wildcards, stage=stage: {"files": list(flatten(plan_of(stage, wildcards).inputs))}),
        output:
            **stage.outputs(study),
        log:
            f"{results(study)}/logs/{stage.label}.log",
        benchmark:
            f"{results(study)}/benchmarks/{stage.label}.tsv"
        priority: stage.priority
        retries: int(stage.resumable)
        threads: lambda wildcards, stage=stage: stage.threads * plan_of(stage, wildcards).processes
        resources:
            mem_mb=lambda wildcards, attempt, stage=stage: attempt * durations.memory_mb(stage.name),
            runtime=durations.limit_minutes(stage.name),
            gpu=lambda wildcards, stage=stage: plan_of(stage, wildcards).gpus,
        params:
            settings=lambda wildcards, stage=stage: plan_of(stage, wildcards).settings.model_dump_json(),
            command=lambda wildcards, stage=stage: command(stage, wildcards),
            code=code_digest(stage.function),
        shell:
            "{params.command} 2> {log}"
