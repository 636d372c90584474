"""Every benchmark runs, at a tiny size: its table is checked, not its times."""

import importlib
import json
from pathlib import Path

import pytest
import torch

from tasklens.settings.network_settings import ClassifierSettings


@pytest.fixture(autouse=True)
def benchmarks(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")


@pytest.mark.parametrize(
    "script, column, options",
    [
        pytest.param("rays", "ratio", ["--rounds", "1"], marks=pytest.mark.slow),
        ("captures", "times faster", ["--rounds", "1"]),
        pytest.param("memory", "peak [GiB]", ["--captures", "5"], marks=pytest.mark.slow),
        ("step", "% of the step", ["--rounds", "1"]),
        pytest.param(
            "simulation", "peak [GB]", ["--rounds", "1", "--lenses", "triplet-tasklens"], marks=pytest.mark.slow
        ),
        ("network", "ratio", ["--rounds", "1"]),
        ("cost", "GPU-hours", ["config/smoke.yaml"]),
        pytest.param("growth", "growth [%]", [], marks=pytest.mark.slow),
        ("existing_lenses", "ray by ray", []),
    ],
)
def test_benchmark_prints_its_table(script, column, options, capsys):
    importlib.import_module(script).main(["--tiny", *options])
    table = capsys.readouterr().out.split("\n\n")[2].splitlines()
    assert f"| {column} |" in table[0] and len(table) >= 3
    assert {line.count("|") for line in table} == {table[0].count("|")}


def test_operations_are_those_of_the_published_networks():
    """Two per multiply-add: 4.09e9 of ResNet50 and 0.22e9 of MobileNetV3 (torchvision's tables), within 2 %."""
    cost = importlib.import_module("cost")
    for model, operations in (("resnet50", 2 * 4.09e9), ("mobilenetv3_large_100", 2 * 0.217e9)):
        with torch.device("meta"):
            network = cost.build_classifier(ClassifierSettings(model=model, pretrained=True))
        assert cost.operations(network, 224) == pytest.approx(operations, rel=0.02)


def test_durations_are_collected_by_study_and_rule(tmp_path):
    """Mean and longest of the jobs of a rule, its largest memory, the minutes of the study; other rows stay."""
    folder = tmp_path / "mine" / "benchmarks" / "psf"
    folder.mkdir(parents=True)
    for name, seconds, memory in (("a", 2.0, 300.0), ("b", 4.0, 500.0)):
        (folder / f"{name}.tsv").write_text(f"s\tmax_rss\n{seconds}\t{memory}\n")
    table = tmp_path / "durations.csv"
    table.write_text("study,rule,seconds,longest_s,memory_mb\nmine,design,60.0,90.0,1000.0\nother,psf,1.0,1.0,1.0\n")
    times = tmp_path / "times.csv"
    times.write_text("study,minutes,cores,per,commit\nother,3,2,seed,a\n")
    done = {"state": "done", "started": 60.0}
    jobs = {"a": {**done, "seconds": 2.0}, "b": {**done, "seconds": 240.0}}
    (tmp_path / "mine/run.json").write_text(json.dumps({"cores": 2, "jobs": jobs}))
    options = ["--table", str(table), "--times", str(times), "--commit", "b"]
    importlib.import_module("durations").main([str(tmp_path / "mine"), *options])
    assert times.read_text().splitlines()[1:] == ["mine,4,2,,b", "other,3,2,seed,a"]
    assert table.read_text().splitlines()[1:] == [
        "mine,design,60.0,90.0,1000.0",
        "mine,psf,3.0,4.0,500.0",
        "other,psf,1.0,1.0,1.0",
    ]
