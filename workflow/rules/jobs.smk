"""One rule for every stage: what a job reads, writes and depends on is declared in `tasklens.pipeline.jobs`."""


def plan_of(stage, wildcards):
    """Settings, inputs and processes of the job with these wildcards."""
    named = {name: wildcards[name] for name in stage.wildcards}
    return stage.plan(study, **(named | ({SEED: int(named[SEED])} if SEED in named else {})))


def launcher(plan):
    """The command line, once for every process of a job."""
    # Snakemake sets the threads of a job to its cores, here those of all its processes.
    together = f"OMP_NUM_THREADS=1 torchrun --standalone --nproc-per-node {plan.processes} -m tasklens.pipeline.cli"
    return "tasklens" if plan.processes == 1 else together


def command(stage):
    """What a person would type for a job of this stage."""
    words = [f"{{wildcards.{name}}}" for name in stage.wildcards if name != SEED]
    seed = ["--seed {wildcards.seed}"] if SEED in stage.wildcards else []
    return " ".join(["{params.launcher}", stage.name.replace("_", "-"), STUDY, *words, *seed, "2> {log}"])


for stage in STAGES.values():

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
            launcher=lambda wildcards, stage=stage: launcher(plan_of(stage, wildcards)),
            code=code_digest(stage.function),
        shell:
            command(stage)
