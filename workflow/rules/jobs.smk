"""One rule for every stage; inputs, outputs and settings of jobs are declared in `tasklens.pipeline.jobs`."""

RULES = {}  # study and stage by the name of the rule


@cache
def plan(study, name, *wildcards):
    """Return the plan of a job, made once: it may list a folder of a million photographs."""
    return STAGES[name].plan_from(EVERY[study], dict(wildcards))


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
    "tolerances": (["csv", "compared_csv"], "Tables"),
    "tasks": (["csv", "psfs"], "Tables"),
    "comparison": (["figure"], "Comparisons"),
    "frames": (["figure"], "Comparisons"),
    "certificate": (["figure"], "Lenses"),
}


def reported(study, stage):
    """Return the outputs of a stage, those that a report shows with caption, category and labels."""
    names, category = REPORTED.get(stage.name, ([], ""))
    labels = {"result": stage.name, "study": study.name} | {name: f"{{{name}}}" for name in stage.wildcards}
    caption = f"../report/{stage.name}.rst"
    return stage.outputs(study) | {
        name: report(path, caption=caption, category=category, labels=labels | {"file": path.suffix})
        for name, path in stage.outputs(study).items()
        if name in names
    }


def declared():
    """Yield the name of each rule, its study and stage, and its plan by wildcards; sweeps have a rule per point."""
    for number, study in enumerate(studies):
        for stage in STAGES.values():
            if callable(stage.patterns) and not stage.outputs(study):
                continue
            name = f"{stage.name}_{number}" if given.sweep else stage.name
            yield name, study, stage
    if given.sweep:
        yield report_jobs.sweep.name, given, report_jobs.sweep


for name, study, stage in declared():  # functions of wildcards are called later: each keeps its own plan
    RULES[name] = study, stage
    plan_of = lambda w, study=study.name, stage=stage.name: plan(study, stage, *w.items())

    rule:
        name:
            name
        input:
            unpack(lambda w, plan_of=plan_of: {"files": [*map(str, flatten(plan_of(w).inputs))]}),
        output:
            **reported(study, stage),
        log:
            f"{results(study)}/logs/{stage.label}.log",
        benchmark:
            stage.benchmark(study)
        priority: stage.priority
        retries: int(stage.resumable)
        localrule: not stage.patterns  # it prints
        threads: lambda w, stage=stage, plan_of=plan_of: stage.threads * plan_of(w).processes
        resources:
            mem_mb=lambda w, attempt, study=study, stage=stage: attempt * durations[study.name].memory_mb(stage.name),
            runtime=lambda w, attempt, study=study, stage=stage: (
                attempt * durations[study.name].limit_minutes(stage.name)
            ),
            gpu=lambda w, plan_of=plan_of: plan_of(w).gpus if gpus else 0,
        params:
            settings=lambda w, plan_of=plan_of: plan_of(w).settings.model_dump_json(),
            command=lambda w, study=study, stage=stage, plan_of=plan_of: (
                f"{stage.command(study, w)} --plan {kept_studies.digest(plan_of(w))}"
            ),
            code=code_digest(stage.function),
        shell:
            "{params.command} 2> {log}"

    if stage is jobs.fine_tune_others:  # `tasklens run fine-tune` makes one of these by hand
        workflow.ruleorder(name, name.replace(jobs.fine_tune_others.name, jobs.fine_tune.name))
