"""The training loop of classifiers."""

from itertools import pairwise

import pytest
import timm
import torch
from examples import random_images, small_network, trained_network
from torch import nn

from tasklens.recognition import evaluation, training
from tasklens.runtime import checkpoints
from tasklens.settings.network_settings import TrainingSettings


def test_training_is_deterministic():
    """One seed, one result to the last bit; another seed, another."""
    first, again, other = (trained_network(seed, epochs=1).state_dict() for seed in (4, 4, 5))
    assert all(torch.equal(first[k], again[k]) for k in first)
    assert not torch.equal(first["0.weight"], other["0.weight"])


def test_training_learns_and_ends_in_eval():
    network = trained_network(0, epochs=20)
    assert not network.training
    correct = evaluation.evaluate(network, random_images(60, 16, 3, seed=2), evaluation.CapturePipeline()).correct
    assert correct.double().mean() > 0.9


def test_what_the_classifier_sees_is_what_it_learns_from():
    """`capture` gets the flipped images in [0, 1]; training on black images cannot learn."""
    network, dataset = small_network(0), random_images(60, 16, 3, seed=1)
    ranges = []

    def capture(images, generator):
        ranges.append((float(images.min()), float(images.max())))
        return 0 * images

    settings = TrainingSettings(epochs=20, learning_rate=1e-2, batch_size=10)
    training.fit(network, dataset, settings, 0, "test", capture)
    assert len(ranges) == 120 and all(0 <= low < high <= 1 for low, high in ranges)
    correct = evaluation.evaluate(network, dataset, evaluation.CapturePipeline()).correct
    assert correct.double().mean() < 0.5


@pytest.mark.parametrize("bad", [1, 5])
def test_a_loss_that_is_not_finite_ends_the_training(bad, monkeypatch, tmp_path):
    """At any step; the last checkpoint is from before that step."""
    steps = iter(range(1, 6))

    def capture(images: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        return images * (float("inf") if next(steps) == bad else 1.0)

    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    checkpoint = checkpoints.Checkpoint(tmp_path / "job.pt")
    dataset, settings = random_images(50, 16, 3, seed=1), TrainingSettings(epochs=1, learning_rate=1e-2, batch_size=10)
    with pytest.raises(FloatingPointError, match=f"step {bad} of 5"):
        training.fit(small_network(0), dataset, settings, 0, "test", capture, checkpoint)
    assert checkpoint.records.get("test", {}).get("step", 0) == bad - 1


def test_weights_that_are_not_finite_in_the_end_are_no_result():
    network = small_network(0)
    network[0].weight.register_hook(lambda gradient: gradient * torch.nan)
    settings = TrainingSettings(epochs=1, learning_rate=1e-2, batch_size=60)
    with pytest.raises(FloatingPointError, match="weights are not finite"):
        training.fit(network, random_images(60, 16, 3, seed=1), settings, 0, "test")


def test_rate_rises_linearly_and_falls_on_a_cosine():
    optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule, rates = training.warmup_cosine(optimizer, 100, 0.1), []
    for _ in range(100):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert rates[:10] == pytest.approx([k / 11 for k in range(1, 11)])
    assert rates[10] == max(rates) == pytest.approx(1)
    assert rates[55] == pytest.approx(0.5) and 0 < rates[-1] < 1e-3
    assert all(a > b for a, b in pairwise(rates[10:]))


def test_every_image_is_used_before_any_repeats():
    order = training.Shuffled(10, 4, torch.Generator().manual_seed(0))
    batches = [order.next() for _ in range(5)]
    assert [len(b) for b in batches] == [4] * 5
    assert torch.cat(batches)[:10].sort().values.tolist() == torch.cat(batches)[10:].sort().values.tolist()
    assert torch.cat(batches)[:10].sort().values.tolist() == list(range(10))


def test_what_timm_exempts_has_no_weight_decay():
    """Embeddings of positions and of the class, besides biases and norms; also in a network around the model."""
    network = nn.Sequential(timm.create_model("test_vit", num_classes=3))
    rates = {
        parameter: group["weight_decay"]
        for group in training.parameter_groups(network, 0.05)
        for parameter in group["params"]
    }
    assert rates.keys() == set(network.parameters())
    for name, parameter in network.named_parameters():
        exempt = parameter.ndim == 1 or name.split(".")[1] in ("pos_embed", "cls_token", "reg_token")
        assert rates[parameter] == (0 if exempt else 0.05), name
