"""One rule for every stage; inputs, outputs and settings of jobs are declared in `tasklens.pipeline.jobs`."""

@cache
def plan(name, *wildcards):
    """Return the plan of a job, made once: it may list a folder of a million photographs."""
    return STAGES[name].plan_from(study, dict(wildcards))


# What `snakemake --report` shows: outputs and category of a stage, with the caption workflow/report/<stage>.rst.
REPORTED = {
    "report": (["report"], "Page"),
    "table": (["csv"], "Tables"),
    "verdicts": (["csv"], "Tables"),
    "psf_tail": (["csv"], "Tables"),
    "effort": (["csv"], "Tables"),
    "regimes": (["csv"], "Tables"),
    "ablation": (["csv"], "Tables"),
    "merit_function": (["csv", "figure"], "Merit function"),
    "comparison": (["figure"], "Comparisons"),
    "frames": (["figure"], "Comparisons"),
    "certificate": (["figure"], "Lenses"),
}


def reported(stage):
    """Return the outputs of a stage, those that a report shows with caption, category and labels."""
    names, category = REPORTED.get(stage.name, ([], ""))
    labels = {"result": stage.name} | {name: f"{{{name}}}" for name in stage.wildcards}
    caption = f"../report/{stage.name}.rst"
    return stage.outputs(study) | {
        name: report(path, caption=caption, category=category, labels=labels | {"file": path.suffix})
        for name, path in stage.outputs(study).items()
        if name in names
    }


for stage in STAGES.values():  # functions of wildcards are called later: each keeps its own stage
    if callable(stage.patterns) and not stage.outputs(study):
        continue

    rule:
        name:
            stage.name
        input:
            unpack(lambda w, stage=stage: {"files": [*map(str, flatten(plan(stage.name, *w.items()).inputs))]}),
        output:
            **reported(stage),
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
