"""List scheduling of a graph of jobs on GPUs, with jobs that fail and run again; the longest chain of the graph."""

import heapq
import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Job:
    """A job: its rule, hours, GPUs, and the names of the jobs that it waits for.

    The hours between checkpoints are 0 for a job without checkpoints; `retries` counts automatic reruns.
    """

    rule: str
    hours: float
    gpus: int
    priority: float
    needs: frozenset[str]
    checkpoint_hours: float = 0.0
    retries: int = 0


@dataclass(frozen=True)
class Run:
    """A simulated run: its hours, those of its GPUs at work, failures, and jobs that exceed their retries."""

    hours: float
    busy: float
    failures: int
    given_up: int


def simulate(
    jobs: Mapping[str, Job],
    gpus: int,
    rank: Callable[[str], float],
    failing: float = 0.0,
    resumed: bool = True,
    seed: int = 0,
) -> Run:
    """Run all jobs; free GPUs take the ready job of the least rank, then the first of `jobs`; CPU jobs never wait.

    Args:
        failing: probability that an attempt fails, at a uniform fraction of its remaining work; the failed job
            is ready again at once, even if no workflow would retry it.
        resumed: whether a job resumes from its last checkpoint; otherwise, or without checkpoints, it restarts.
        seed: seed of the failures; they depend on the job and its attempt, not on the order of the jobs.
    """
    order = {name: (rank(name), number, name) for number, name in enumerate(jobs)}
    missing = {name: len(job.needs) for name, job in jobs.items()}
    followers: dict[str, list[str]] = {name: [] for name in jobs}
    for name, job in jobs.items():
        for need in job.needs:
            followers[need].append(name)
    left, attempts = {name: job.hours for name, job in jobs.items()}, dict.fromkeys(jobs, 0)
    ready = sorted((jobs[name].gpus > 0, *order[name]) for name, count in missing.items() if not count)
    running: list[tuple[float, str, bool]] = []
    now, busy, free, failures = 0.0, 0.0, gpus, 0
    while ready or running:
        while ready and jobs[ready[0][-1]].gpus <= free:  # jobs without a GPU come first
            name = heapq.heappop(ready)[-1]
            job = jobs[name]
            luck = random.Random(f"{seed} {name} {attempts[name]}")
            failed = luck.random() < failing
            hours = left[name] * (luck.random() if failed else 1.0)
            if failed and resumed and job.checkpoint_hours:
                left[name] -= job.checkpoint_hours * math.floor(hours / job.checkpoint_hours)
            elif failed:
                left[name] = job.hours
            attempts[name] += 1
            free, busy, failures = free - job.gpus, busy + job.gpus * hours, failures + failed
            heapq.heappush(running, (now + hours, name, failed))
        now, name, failed = heapq.heappop(running)
        free += jobs[name].gpus
        freed = [name] if failed else []
        for follower in () if failed else followers[name]:
            missing[follower] -= 1
            if not missing[follower]:
                freed.append(follower)
        for label in freed:
            heapq.heappush(ready, (jobs[label].gpus > 0, *order[label]))
    return Run(now, busy, failures, sum(attempts[name] > 1 + job.retries for name, job in jobs.items()))


def chains(jobs: Mapping[str, Job]) -> dict[str, float]:
    """Hours from the start of each job to the end of the last job that depends on it, on unlimited GPUs."""
    followers: dict[str, list[str]] = {name: [] for name in jobs}
    for name, job in jobs.items():
        for need in job.needs:
            followers[need].append(name)
    hours: dict[str, float] = {}

    def length(name: str) -> float:
        if name not in hours:
            hours[name] = jobs[name].hours + max(map(length, followers[name]), default=0.0)
        return hours[name]

    for name in jobs:
        length(name)
    return hours


def critical_path(jobs: Mapping[str, Job]) -> list[str]:
    """Names of the jobs of the longest chain, in the order of time."""
    lengths = chains(jobs)
    path = [max((name for name, job in jobs.items() if not job.needs), key=lambda name: lengths[name])]
    while following := [name for name, job in jobs.items() if path[-1] in job.needs]:
        path.append(max(following, key=lambda name: lengths[name]))
    return path
