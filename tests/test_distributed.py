"""Two processes that fine-tune a classifier together give the metrics of one."""

from pathlib import Path

import pytest
import timm
import torch
from examples import changed, read_rows, tiny_study
from rules import finish
from workflows import snakemake

from tasklens.runtime import distributed
from tasklens.runtime.distributed import ProcessGroup
from tasklens.runtime.files import read_tensors
from tasklens.study.loading import parse

VIT = {
    "model": "vit_tiny_patch16_224",  # no batch norms: on a CPU their statistics cover only each process's share
    "arguments": {"img_size": 16, "patch_size": 8, "embed_dim": 12, "depth": 1, "num_heads": 1},
    "training": {"epochs": 1, "learning_rate": 1.0e-3, "batch_size": 16},
}


@pytest.mark.slow
def test_two_processes_give_the_metrics_of_one(tmp_path, monkeypatch):
    """Accuracies of all fields within one image, weights within rounding; only one process writes."""
    study = changed(changed(tiny_study(), "classifiers.small", VIT), "fine_tuning.epochs", 2)
    monkeypatch.chdir(tmp_path)
    target = "results/tiny/metrics/singlet-imaging1/seed0/small.csv"
    metrics, weights = Path(target), Path("results/tiny/classifiers/singlet-imaging1/seed0/small.safetensors")

    def read_metrics() -> dict[tuple[str, str], float]:
        return {(row["metric"], row["field"]): float(row["value"]) for row in read_rows(metrics)}

    lens = {"lens": "singlet-imaging1", "seed": 0}
    finish("images", parse(study))
    finish("reference", parse(study), classifier="small")
    for rule in ("design", "psfs"):
        finish(rule, parse(study), **lens)
    finish("fine_tune", parse(study), measured_name="small", **lens)
    alone = read_metrics()
    expected = {name: value.clone() for name, value in read_tensors(weights)[0].items()}
    for path in (metrics, weights):
        path.unlink()
    done = snakemake(tmp_path, changed(study, "classifiers.small.processes", 2), target, "--config", "overwrite=true")
    log = Path("results/tiny/logs/fine_tune/singlet-imaging1-small-seed0.log").read_text()
    assert done.returncode == 0 and "1/1  fine_tune" in done.stderr, log
    assert log.count("fine-tune  step 1/") == 1
    torch.testing.assert_close(read_tensors(weights)[0], expected, rtol=0, atol=1e-5)
    together = read_metrics()
    assert together.keys() == alone.keys()
    image = 100 / study["images"]["test"] + 1e-6
    for key, value in alone.items():
        assert together[key] == pytest.approx(value, abs=image if "accuracy" in key[0] else 1e-6), key


def test_batch_norms_of_a_process_group_keep_their_activations(monkeypatch):
    """timm merges norm and activation into one layer; a network converted for several GPUs gives the same logits."""
    monkeypatch.setattr(distributed, "DistributedDataParallel", lambda network: network)
    torch.manual_seed(0)
    network = timm.create_model("test_efficientnet", num_classes=5).eval()
    images = torch.rand(2, 3, 64, 64)
    expected = network(images)
    converted = ProcessGroup(0, 2, torch.device("cuda", 0)).wrap(network).eval()
    assert any(isinstance(module, torch.nn.SyncBatchNorm) for module in converted.modules())
    torch.testing.assert_close(converted(images), expected)


def test_shares_are_of_one_size():
    assert [list(range(6))[ProcessGroup(rank, 3).share] for rank in range(3)] == [[0, 3], [1, 4], [2, 5]]
