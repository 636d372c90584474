"""The graph of the jobs of a study's tables, as its stages declare them, with counted or measured hours."""

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import cost
import torch
from scheduling import Job

from tasklens.pipeline import jobs, report_jobs
from tasklens.pipeline.forecast import elsewhere
from tasklens.pipeline.stage import STAGES, Stage, flatten, results
from tasklens.runtime.checkpoints import INTERVAL
from tasklens.study import names
from tasklens.study.study import TABLES, Study

TRAIN, TEST, DECODED = 1_281_167, 50_000, 800.0  # ImageNet; images/s of eight threads, assumed


def patterns(study: Study) -> list[tuple[re.Pattern, Stage]]:
    """Expressions of all outputs, and their stages; the other classifiers' first, as the Snakefile orders rules."""
    measured = [*study.classifiers, *map(names.restored, study.classifiers)]
    limited = {"classifier": study.classifiers, "measured_name": measured, "table": TABLES, "ablation": study.ablations}
    found = []
    for stage in sorted(STAGES.values(), key=lambda stage: stage is not jobs.fine_tune_others):
        for pattern in stage.outputs(study).values() if stage.patterns_in(study) else ():
            text = str(pattern)
            for name in stage.wildcards:
                group = f"(?P<{name}>{'|'.join(limited.get(name, ['[^/]+']))})"
                text = text.replace(f"{{{name}}}", group, 1).replace(f"{{{name}}}", f"(?P={name})")
            found.append((re.compile(text), stage))
    return found


def graph(study: Study) -> dict[str, Job]:
    """All jobs that the tables wait for, by label, as the stages declare them."""
    counted, known, expressions = cost.Cost(study, TRAIN, TEST), elsewhere("small"), patterns(study)
    with torch.device("meta"):
        rate = cost.TO_WEIGHTS * cost.A100 * cost.operations(cost.build_classifier(cost.RESNET50), 224)

    @cache
    def seconds(stage: str, lens: str, name: str) -> float:
        operations = 0.0
        if stage == "images":
            return (TRAIN + TEST) / DECODED
        if stage == "design":
            operations = counted.design(lens)
        elif stage == "restore":
            operations = counted.restore()
        elif stage.startswith("fine_tune"):
            pairs = [names.split(name)] if name else [(other, False) for other in jobs.others(study)]
            operations = sum(counted.fine_tune(lens, *pair) for pair in pairs)
        return operations / rate or (known[stage].seconds if stage in known else 1.0)

    @cache
    def maker(path: Path) -> tuple[str, Stage, Mapping[str, str]]:
        matches = ((stage, expression.fullmatch(str(path))) for expression, stage in expressions)
        stage, match = next(each for each in matches if each[1])
        return stage.label.format(**match.groupdict()), stage, match.groupdict()

    told = (report_jobs.verdicts, report_jobs.psf_tail, report_jobs.effort, report_jobs.report)  # as target `tables`
    waiting = [report_jobs.table.output(study, "csv", table=name) for name in study.tables]
    waiting += [next(iter(stage.outputs(study).values())) for stage in told]
    found: dict[str, Job] = {}
    while waiting:
        label, stage, wildcards = maker(waiting.pop())
        if label not in found:
            plan = stage.plan_from(study, wildcards)
            inputs = [path for path in flatten(plan.inputs) if path.is_relative_to(results(study))]
            waiting += inputs
            hours = seconds(stage.name, wildcards.get("lens", ""), wildcards.get("measured_name", "")) / 3600
            needs, saved = frozenset(maker(path)[0] for path in inputs), stage.resumable * INTERVAL / 3600
            found[label] = Job(stage.name, hours, plan.gpus, stage.priority, needs, saved, int(stage.resumable))
    return dict(sorted(found.items(), key=lambda item: (list(STAGES).index(item[1].stage), item[0])))
