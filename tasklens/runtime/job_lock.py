"""One process at a time for each job: when Snakemake is killed, its jobs go on, and the next run starts them again."""

import json
import os
import socket
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock

from tasklens.runtime.files import write_text
from tasklens.runtime.locks import acquire, wait_until


@contextmanager
def alone(path: Path, key: str, outputs: Iterable[Path]) -> Iterator[bool]:
    """Let no other process run a job while the block runs; wait for one that already does.

    Args:
        path: path of the lock; the last process that held it leaves its host and id in a JSON file of the same name.
        key: digest of what the job computes.
        outputs: outputs of the job.

    Yields:
        True if there is work; false if this process waited for another that computed the same, and its outputs exist.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    lock, record = FileLock(path), path.with_suffix(".json")
    waited = not acquire(lock)
    if waited:
        other = _read(record)
        wait_until(lambda: acquire(lock), f"process {other.get('pid')} on {other.get('host')}, which runs this job")
    try:
        done = waited and _read(record).get("done") == key and all(output.exists() for output in outputs)
        process = {"pid": os.getpid(), "host": socket.gethostname()}
        if not done:
            write_text(record, json.dumps(process))
        yield not done
        if not done:  # not reached if the job fails or is killed: older outputs may exist then
            write_text(record, json.dumps(process | {"done": key}))
    finally:
        lock.release()


def _read(record: Path) -> dict[str, Any]:
    try:
        return json.loads(record.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # not written yet, or by a killed process
        return {}
