"""The command, the study that it writes, Python and the verdict of a design give the same answers of a network."""

import json

import pandas
import pytest
import timm
import torch
from examples import trained_resnet, write_photographs
from safetensors.torch import load_file
from studies import measurement

import tasklens
from tasklens.cli.app import main
from tasklens.optics.analysis.focus import move_image_plane
from tasklens.recognition.dataset import ImageDataset
from tasklens.show import predictions

CLASSES = ("coarse", "fine", "medium")


def stripes(count: int, seed: int) -> ImageDataset:
    """Noisy stripes of three periods, which blur makes alike."""
    generator = torch.Generator().manual_seed(seed)
    labels = torch.arange(count) % len(CLASSES)
    period = torch.tensor([9.0, 4.0, 6.0])[labels][:, None, None]
    phase = torch.arange(32) / period + torch.rand(count, 1, 1, generator=generator)
    waves = torch.sin(2 * torch.pi * phase)[:, None].expand(count, 3, 32, 32)
    images = 127 + 45 * waves + 10 * torch.randn(count, 3, 32, 32, generator=generator)
    return ImageDataset(images.clamp(0, 255).byte(), labels, CLASSES)


@pytest.mark.slow
def test_every_door_gives_the_same_answers(here, capsys):
    """For a designed lens and the same out of focus, both measured where their files put the image plane."""
    write_photographs(here / "stripes/test", stripes(60, seed=0), CLASSES)
    training = stripes(120, seed=1)
    write_photographs(here / "stripes/train", training, CLASSES)
    trained_resnet(here / "mine.safetensors", training, epochs=10, batch_size=10)
    images = ("--images", "stripes", "--size", "32", "--network", "test_resnet", "--weights", "mine.safetensors")
    quick = ("descents.0.steps=2", "rays=64", "batch_size=2")
    options = [word for setting in quick for word in ("--set", setting)]
    surfaces = [{"radius": 1.6, "thickness": 0.7, "material": "COC", "stop": True}, {"radius": -4.0}]
    sensor = {"pixel_pitch_um": 4.0, "kernel_size": 15}
    start, view = tasklens.lens(surfaces, field_of_view_deg=30, f_number=4, **sensor)
    tasklens.save_lens("start.yaml", start, view)
    command = ("design", "--start", "start.yaml", "--method", "task", *images, *options, "--json")
    assert main([*command, "-o", "designed.yaml"]) == 0
    verdict = json.loads(capsys.readouterr().out)["verdict"]

    designed, view = tasklens.load_lens("designed.yaml")
    tasklens.save_lens("blurred.yaml", move_image_plane(designed, 0.1), view)
    names = ("designed", "blurred")
    files = [f"{name}.yaml" for name in names]
    size = ("--diagonal", repr(2 * float(view.radii.max())), "--pixel-pitch", "4", "--kernel-size", "15")
    assert main(["rank", *files, *images, *size, "--name", "command"]) == 0
    weights = load_file("mine.safetensors")
    module = timm.create_model("test_resnet", num_classes=3)
    module.load_state_dict(weights)
    result = tasklens.rank({name: tasklens.load_lens(f"{name}.yaml") for name in names}, "stripes", module, size=32)

    for name in names:
        study = predictions.read(measurement("command", f"lens-{name}", "network", kind="-predictions"))
        assert study.to_numpy().tolist() == result.correct[name].to_numpy().tolist()
    accuracies = [100 * result.correct[name].to_numpy().mean() for name in names]
    assert accuracies[0] > accuracies[1] + 10
    assert f"recognises {accuracies[0]:.1f} % through this lens" in verdict
    table = pandas.read_csv("results/command/tables/ranking.csv").set_index("lens")
    assert table.loc[list(names), "accuracy"].tolist() == pytest.approx(accuracies, abs=1e-9)
    assert set(table["focus"]) == {"file"} and (table["image_plane_shift_um"] == 0).all()
