"""The graph of the jobs of a study's tables, as Snakemake plans them, with counted or measured hours."""

from collections.abc import Sequence
from functools import cache

import cost
import torch
from scheduling import Job

from tasklens.pipeline.changes import PlannedJob
from tasklens.pipeline.forecast import elsewhere
from tasklens.runtime.checkpoints import INTERVAL
from tasklens.settings import names
from tasklens.study.parts import whole_study_name
from tasklens.study.study import Study

TRAIN, TEST, DECODED = 1_281_167, 50_000, 800.0  # ImageNet; images/s of eight threads, assumed
ON_GPU = ("reference", "design", "restore", "fine_tune")  # rules that need a GPU; designs, if images supervise
RESUMED = ("images", *ON_GPU)  # rules with checkpoints, which are retried


def graph(study: Study, planned: Sequence[PlannedJob]) -> dict[str, Job]:
    """Return all planned jobs of a study by label."""
    costs, measured = cost.Cost(study, TRAIN, TEST), elsewhere("small")
    with torch.device("meta"):
        rate = cost.TO_WEIGHTS * cost.A100 * cost.operations(cost.build_classifier(cost.RESNET50), 224)

    @cache
    def seconds(rule: str, lens: str, name: str) -> float:
        operations = 0.0
        if rule == "images":
            return (TRAIN + TEST) / DECODED
        if rule == "design":
            operations = costs.design(lens)
        elif rule == "restore":
            operations = costs.restore()
        elif rule == "fine_tune":
            operations = costs.fine_tune(lens, *names.split(name))
        return operations / rate or (measured[rule].seconds if rule in measured else 1.0)

    jobs = {}
    for job in (job for job in planned if job.study == whole_study_name(job.study)):  # pages of parts take seconds
        lens, name = wildcards(job.label)
        hours = seconds(job.rule, lens, name) / 3600
        gpus = int(job.rule in ON_GPU and (job.rule != "design" or study.lens(lens).supervised))
        resumed = job.rule in RESUMED
        saved = resumed * INTERVAL / 3600
        jobs[job.label] = Job(job.rule, hours, gpus, job.priority, frozenset(job.needs), saved, int(resumed))
    return jobs


def wildcards(label: str) -> tuple[str, str]:
    """Return the lens and the measured name of a job, from a label such as fine_tune/doublet-tasklens-resnet-seed0."""
    rule, _, rest = label.partition("/")
    words = rest.rpartition("-seed")[0].split("-")
    if rule == "design":
        return "-".join(words), ""
    if rule != "fine_tune":
        return "", ""
    count = 1 if words[0] == names.SHARP else 2
    return "-".join(words[:count]), "-".join(words[count:])
