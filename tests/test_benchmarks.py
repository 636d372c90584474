"""Every benchmark runs, at a tiny size: its table is checked, not its times."""

import importlib
from pathlib import Path

import pytest
import torch
from examples import make_lens

from tasklens.optics.analysis.paraxial import paraxial
from tasklens.optics.analysis.spots import centroid, rms_spot_radius
from tasklens.settings.network_settings import ClassifierSettings


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
def test_benchmark_prints_its_table(script, column, options, monkeypatch, capsys):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    importlib.import_module(script).main(["--tiny", *options])
    table = capsys.readouterr().out.split("\n\n")[2].splitlines()
    assert f"| {column} |" in table[0] and len(table) >= 3
    assert {line.count("|") for line in table} == {table[0].count("|")}


def test_a_near_object_is_imaged_by_newtons_equation(monkeypatch):
    """x x' = f^2 and m = -f / x, for distances from the foci; the front focus is the back focus of the reversed lens.

    Through a small pupil: image height within a relative 1e-6, spot within 1e-6 mm.
    """
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    script = importlib.import_module("existing_lenses")
    front, back, distance, tangent = 0.2, -0.1, 30.0, 1e-3
    reversed_lens = make_lens([-back, -front], [2.0, 1.0], ("COC", "air"), semi_diameter=[1e-3, torch.inf])
    focus = float(paraxial(reversed_lens, 0.5893).bfl)
    media, stop = ("air", "COC", "air"), [1e-3, torch.inf, torch.inf]
    lens = make_lens([0.0, front, back], [1.0, 2.0, 1.0], media, semi_diameter=stop)
    first_order = paraxial(lens, 0.5893)
    f, x = float(first_order.efl), distance + 1.0 - focus  # the stop is 1 mm in front of the lens
    lens = make_lens([0.0, front, back], [1.0, 2.0, float(first_order.bfl) + f**2 / x], media, semi_diameter=stop)
    view = script.view_along_y(lens, [0.0, tangent], (0.5893,))
    _, rays = script.through_paraxial_pupil(lens, view, script.square_grid(5), 1 / distance)
    assert rays.valid.all()
    middle = centroid(rays)
    assert float(middle[1, 1]) == pytest.approx(f / x * tangent * distance, rel=1e-6)
    assert float(rms_spot_radius(rays, middle).max()) < 1e-6


def test_operations_are_those_of_the_published_networks(monkeypatch):
    """Two per multiply-add: 4.09e9 of ResNet50 and 0.22e9 of MobileNetV3 (torchvision's tables), within 2 %."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    cost = importlib.import_module("cost")
    for model, operations in (("resnet50", 2 * 4.09e9), ("mobilenetv3_large_100", 2 * 0.217e9)):
        with torch.device("meta"):
            network = cost.build_classifier(ClassifierSettings(model=model, pretrained=True))
        assert cost.operations(network, 224) == pytest.approx(operations, rel=0.02)


def test_times_are_taken_in_turn(monkeypatch, capsys):
    """A warm-up each, then A B A B; medians, ranges and ratios of what was measured."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    timing = importlib.import_module("timing")
    called: list[str] = []
    times = timing.alternate({name: lambda name=name: called.append(name) for name in "AB"}, 3)
    assert "".join(called) == "ABABABAB"
    assert all(len(values) == 3 and min(values) >= 0 for values in times.values())
    assert timing.spread([0.003, 0.001, 0.002], 1e3) == "2 (1 to 3)"
    assert timing.ratio([2.0, 3.0, 8.0], [1.0, 1.0, 2.0]) == "3 (2 to 4)"


def test_durations_are_collected_by_study_and_rule(tmp_path, monkeypatch):
    """Mean and longest of the jobs of a rule, its largest memory; rows of other rules and studies stay."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    folder = tmp_path / "mine" / "benchmarks" / "psf"
    folder.mkdir(parents=True)
    for name, seconds, memory in (("a", 2.0, 300.0), ("b", 4.0, 500.0)):
        (folder / f"{name}.tsv").write_text(f"s\tmax_rss\n{seconds}\t{memory}\n")
    table = tmp_path / "durations.csv"
    table.write_text("study,rule,seconds,longest_s,memory_mb\nmine,design,60.0,90.0,1000.0\nother,psf,1.0,1.0,1.0\n")
    importlib.import_module("durations").main([str(tmp_path / "mine"), "--table", str(table)])
    assert table.read_text().splitlines()[1:] == [
        "mine,design,60.0,90.0,1000.0",
        "mine,psf,3.0,4.0,500.0",
        "other,psf,1.0,1.0,1.0",
    ]
