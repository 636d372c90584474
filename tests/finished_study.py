"""The tiny study of one classifier: its jobs, and what they leave in the current folder."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import yaml
from examples import read_rows
from rules import finish, outputs
from studies import tiny_study

from tasklens.settings.names import split
from tasklens.settings.starts import imaging_designs
from tasklens.study.loading import parse
from tasklens.study.study import TABLES
from tasklens.study.table_contents import verification

TINY = tiny_study() | {"name": "verified", "classifiers": {"small": tiny_study()["classifiers"]["small"]}}
STUDY = parse(TINY)


def make() -> None:
    """Run all jobs in the order of their dependencies."""
    finish("images", STUDY)
    finish("reference", STUDY, classifier="small")
    imaging = list(imaging_designs(STUDY.designs))
    for name in (*imaging, *(name for name in STUDY.designs if name not in imaging)):
        for rule in ("design", "psfs"):
            finish(rule, STUDY, lens=f"singlet-{name}", seed=0)
        if name in imaging:  # the end-to-end design starts from the best of these
            finish("fine_tune", STUDY, lens=f"singlet-{name}", measured_name="small", seed=0)
    for lens, name in verification(STUDY).measured:
        if split(name)[1]:
            finish("restore", STUDY, lens=lens, seed=0)
        for rule in ("fine_tune", "reproduce"):
            finish(rule, STUDY, lens=lens, measured_name=name, seed=0)
    for name in TABLES:
        finish("table", STUDY, table=name)
    finish("verdicts_table", STUDY)
    finish("psf_tail_table", STUDY)


@contextmanager
def kept(*paths: Path) -> Iterator[None]:
    """Give files the text that they have now when the block ends."""
    texts = {path: path.read_text() for path in paths}
    try:
        yield
    finally:
        for path, text in texts.items():
            path.write_text(text)


def measured_path(output: str, lens: str, measured_name: str = "small") -> Path:
    return getattr(outputs("fine_tune", STUDY, lens=lens, measured_name=measured_name, seed=0), output)


def values(path: Path, metric: str) -> list[float]:
    return [float(row["value"]) for row in read_rows(path) if row["metric"] == metric]


def design_outputs(name: str):
    return outputs("design", STUDY, lens=f"singlet-{name}", seed=0)


def content_of(name: str) -> dict:
    return yaml.safe_load(design_outputs(name).lens.read_text())
