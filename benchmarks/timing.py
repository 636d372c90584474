"""Two ways to do one thing, timed alternately on one thread; peak memory; the line that says on which machine.

Processor time, not wall time: it hardly changes when other work shares the machine. One thread, because studies give a
job a thread.
"""

import argparse
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable, Iterable
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before torch reads it

import torch

torch.set_num_threads(1)

RESULTS = Path(__file__).with_name("results")


def alternate(work: dict[str, Callable[[], object]], rounds: int, calls: int = 1) -> dict[str, list[float]]:
    """Processor times [s] of a call of each entry of `work`, run in turn (A B A B ...) after one warm-up each.

    With several calls in each turn, the time is their mean. A single call of a millisecond starts with caches full of
    the other entry's data.
    """
    for function in work.values():
        function()
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(rounds):
        for name, function in work.items():
            begin = time.process_time()
            for _ in range(calls):
                function()
            times[name].append((time.process_time() - begin) / calls)
    return times


def spread(values: list[float], scale: float = 1.0) -> str:
    """Median and range, such as `12.3 (12.1 to 13.0)`, of `values` times `scale`."""
    middle, low, high = (scale * v for v in (statistics.median(values), min(values), max(values)))
    return f"{middle:.3g} ({low:.3g} to {high:.3g})"


def ratio(slow: list[float], fast: list[float]) -> str:
    """Median and range of how many times longer `slow` took in each round."""
    return spread([a / b for a, b in zip(slow, fast, strict=True)])


def peak_memory_gib() -> float:
    """Largest resident memory of this process so far [GiB]; Linux counts in KiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def machine() -> str:
    """The processor, the threads and torch's version in a line."""
    cpus = Path("/proc/cpuinfo")
    names = [line.split(":")[1].strip() for line in cpus.read_text().splitlines() if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    threads, arithmetic = torch.get_num_threads(), torch.backends.cpu.get_cpu_capability()
    return f"{name} ({arithmetic}), {threads} thread of {os.cpu_count()}, torch {torch.__version__}"


def arguments(description: str) -> argparse.ArgumentParser:
    """Options that every benchmark has."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--save", metavar="NAME", help="write benchmarks/results/NAME.md as well")
    parser.add_argument("--tiny", action="store_true", help="sizes of no meaning, to see that it runs")
    return parser


def report(title: str, columns: tuple[str, ...], rows: Iterable[tuple], save: str | None = None) -> None:
    """Print a Markdown table, and write it to a file under results/ if `save` names one."""
    lines = [f"### {title}", "", machine(), ""]
    lines += [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    lines += [f"| {' | '.join(map(str, row))} |" for row in rows]
    text = "\n".join(lines) + "\n"
    print(text, flush=True)
    if save:
        RESULTS.mkdir(exist_ok=True)
        with (RESULTS / f"{save}.md").open("a") as file:
            file.write(text + "\n")
