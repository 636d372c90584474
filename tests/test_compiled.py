"""Compilation of the tracer: once per installation and source text; uncompiled code traces the same rays."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from examples import WAVELENGTHS, random_lens, random_rays

from tasklens.optics.tracing import block
from tasklens.optics.tracing.trace import trace

TRACE = """
import sys; sys.path.insert(0, {tests!r})
import torch
from examples import WAVELENGTHS, random_lens, random_rays
from tasklens.optics.tracing.trace import trace
from tasklens.optics.tracing import kernel
lens, rays = random_lens(3), random_rays(9, 1, height=1.2, tangent=0.8)
leaf = lens.alpha.clone().requires_grad_()
from dataclasses import replace
image = trace(replace(lens, alpha=leaf), rays, lens.refractive_indices(WAVELENGTHS))
image.x.sum().backward()
torch.save([image.x.detach(), image.path.detach(), image.status, leaf.grad], {out!r})
print(hasattr(kernel.trace, "signatures"))
"""


def run(code: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], env=os.environ | environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.slow
def test_plain_python_traces_the_same_rays(tmp_path):
    """NUMBA_DISABLE_JIT=1 runs the same code slowly, for machines without compilation."""
    traces = {}
    for name, environment in {"compiled": {}, "plain": {"NUMBA_DISABLE_JIT": "1"}}.items():
        out = str(tmp_path / name)
        is_compiled = run(TRACE.format(tests=str(Path(__file__).parent), out=out), **environment)
        assert is_compiled == str(name == "compiled")
        traces[name] = torch.load(out)
    assert len(traces["plain"][2].unique()) > 1
    for plain, compiled in zip(traces["plain"], traces["compiled"], strict=True):
        torch.testing.assert_close(plain, compiled, rtol=1e-12, atol=1e-14)


@pytest.mark.slow
def test_compiled_code_is_kept_on_disk(tmp_path):
    """In a folder per source text; another process loads the code and traces the same bits.

    The code is compiled for the baseline x86-64 processor, without wide vectors: it traces the same rays.
    """
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from examples import WAVELENGTHS, random_lens, random_rays\n"
        "from tasklens.optics.tracing import derivatives, kernel\n"
        "from tasklens.optics.tracing.trace import compile_tracer, trace\n"
        "compile_tracer()\n"
        "lens, rays = random_lens(3), random_rays(300, 1, height=1.0, tangent=0.7)\n"
        "leaf = lens.alpha.requires_grad_()\n"
        "image = trace(lens, rays, lens.refractive_indices(WAVELENGTHS))\n"
        "image.path.sum().backward()\n"
        "hits = [sum(f.stats.cache_hits.values()) for f in (kernel.trace, derivatives.reverse, derivatives.forward)]\n"
        "print(sum(hits), image.x.detach().numpy().tobytes().hex(), leaf.grad.numpy().tobytes().hex())"
    )
    environment = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)}
    hits, *cold = run(code, **environment).split()
    assert hits == "0"
    (folder,) = (tmp_path / "tasklens").iterdir()
    assert list(folder.rglob("kernel.trace-*.nbc"))
    hits, *warm = run(code, **environment).split()
    assert hits == "3" and warm == cold
    lens, rays = random_lens(3), random_rays(300, 1, height=1.0, tangent=0.7)
    expected = trace(lens, rays, lens.refractive_indices(WAVELENGTHS)).x
    x = torch.frombuffer(bytearray.fromhex(cold[0]), dtype=torch.float64).reshape(expected.shape)
    torch.testing.assert_close(x, expected, rtol=1e-12, atol=1e-13)


def test_the_folder_follows_every_module(tmp_path, monkeypatch):
    """numba alone checks only the file of a function, not the files of the functions that it calls."""
    before = block._cache_folder()
    changed = tmp_path / "tracing"
    changed.mkdir()
    for path in Path(block.__file__).parent.glob("*.py"):
        (changed / path.name).write_text(path.read_text())
    monkeypatch.setattr(block, "__file__", str(changed / "block.py"))
    assert block._cache_folder() == before
    with (changed / "refraction.py").open("a") as file:
        file.write("# other\n")
    assert block._cache_folder() != before


def test_a_folder_that_cannot_be_made_does_not_stop_it(tmp_path):
    code = (
        "import numpy; from tasklens.optics.tracing.crossing import first_crossing;"
        "print(first_crossing(0.0, 0.0, -2.0, 0.0, 0.0, 1.0, numpy.zeros(5), numpy.zeros(8)))"
    )
    (tmp_path / "file").write_text("")
    assert run(code, NUMBA_CACHE_DIR=str(tmp_path / "file")) == "2.0"
