"""One CPU thread for every test, so that sums have the same order everywhere, and a lens that many tests share."""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["NUMBA_NUM_THREADS"] = "1"  # otherwise parallel code of Optiland resets torch to two threads, and they wait
os.environ["CUDA_VISIBLE_DEVICES"] = ""

import numpy
import pytest
import torch
from examples import materials

from tasklens.design.random_starts import random_starts
from tasklens.design.start import flat
from tasklens.optics.view import view_of_spec
from tasklens.study.settings import Constraints, Spec

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def start():
    """A random doublet of the right focal length."""
    spec, limits = Spec(kernel_size=11), Constraints()
    flat_lens = flat(materials("COC", "OKP4"), spec, limits)
    return random_starts(flat_lens, view_of_spec(spec), limits, 1, numpy.random.default_rng(0))[0]


# The longest tests, with which two processes begin: otherwise the last of them would leave one process idle.
LONGEST = (
    "test_workflow_runs.py",
    "test_structure.py",
    "test_checkpoints.py",
    "test_cli.py",
    "test_simulation.py",
    "test_task_design.py",
    "test_benchmarks.py",
)


def pytest_collection_modifyitems(items):
    order = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(LONGEST)))
