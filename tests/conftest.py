"""One CPU thread for every test, so that sums have the same order everywhere, and two lenses that many tests share."""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["NUMBA_NUM_THREADS"] = "1"  # otherwise parallel code of Optiland resets torch to two threads, and they wait
if "TASKLENS_TEST_GPU" not in os.environ:
    os.environ["CUDA_VISIBLE_DEVICES"] = ""

import numpy
import pytest
import torch
from designs import LIMITS, SPEC, VIEW, spot_descent
from examples import materials
from threadpoolctl import threadpool_limits

from tasklens.design import criteria, optimum
from tasklens.design.start import flat, random_starts

torch.set_num_threads(1)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The current folder, which is empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def two_threads():
    """Two threads of torch, numpy and scipy during a test."""
    with threadpool_limits(2):
        torch.set_num_threads(2)
        yield
        torch.set_num_threads(1)


@pytest.fixture
def few_rays(monkeypatch):
    """Validation with 64 rays, and the test of an optimum with 64 rays and one step: a tenth of their time."""
    monkeypatch.setattr(criteria, "VALIDATION_RAYS", 64)
    monkeypatch.setattr(optimum, "_RAYS", 64)
    monkeypatch.setattr(optimum, "_DIRECTIONS", 0)
    monkeypatch.setattr(optimum, "STEPS_UM", (0.5,))


@pytest.fixture(scope="session")
def start():
    """A random doublet of the right focal length."""
    plates = flat(materials("COC", "OKP4"), SPEC, LIMITS)
    return random_starts(plates, VIEW, LIMITS, 1, numpy.random.default_rng(0))[0]


@pytest.fixture(scope="session")
def spot_lens(start):
    """The doublet after 200 steps of spot descent, which violates limits a little."""
    return spot_descent(start)


# The longest tests, with which two processes begin: otherwise the last of them would leave one process idle.
LONGEST = (
    "test_examples.py",
    "test_docs.py",
    "test_ranking.py",
    "test_workflow_runs.py",
    "test_workflow.py",
    "test_checkpoints.py",
    "test_finished.py",
    "test_structure.py",
    "test_digests.py",
    "test_compiled.py",
    "test_cli.py",
    "test_new_study.py",
    "test_simulation.py",
    "test_module.py",
    "test_task_design.py",
    "test_benchmarks.py",
)


def pytest_collection_modifyitems(items):
    order = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(LONGEST)))
