"""GPU code paths: on a pretended GPU devices never mix and numbers equal those of the CPU; on a real one, nearly."""

from dataclasses import replace

import pytest
import torch
from designs import LEARNING_RATES, LIMITS, VIEW
from examples import by_descents, random_images, small_network
from pretend_gpu import CPU, GPU, OnGpu, pretend_gpu
from torch.utils._python_dispatch import _disable_current_modes

import tasklens
from restoration import nafnet_training as restoration
from tasklens.api import ranking as api_ranking
from tasklens.camera.imaging import PsfCamera
from tasklens.design.criteria import JointTaskLoss, TaskLoss
from tasklens.design.objective import Objective
from tasklens.design.problem import Problem
from tasklens.optics.analysis.pupil import sobol_disc
from tasklens.recognition import evaluation, training
from tasklens.recognition.classifiers import frozen
from tasklens.recognition.evaluation import CapturePipeline
from tasklens.settings.capture_settings import CaptureSettings, SensorSettings
from tasklens.settings.design_settings import DescentSettings
from tasklens.settings.network_settings import RestorationSettings, TrainingSettings

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*CUDA is not available.*Disabling autocast"),
    pytest.mark.usefixtures("few_rays"),
]
without_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
with_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
CAPTURE = CaptureSettings(sensor=SensorSettings())
NAFNET = RestorationSettings(width=4, encoder=(1,), decoder=(1,), steps=4, check=2, batch_size=4)


def data(device, count=40):
    return replace(random_images(count, 16, 3, 0), device=device)


def camera(device) -> PsfCamera:
    psf = torch.rand(9, 3, 5, 5, generator=torch.Generator().manual_seed(0))
    psf = psf / psf.sum((-2, -1), keepdim=True)
    return PsfCamera.of(CAPTURE, psf.to(device), torch.linspace(1, 0.5, 9).to(device))


def fine_tuning(device, start) -> list[float]:
    """Accuracies and losses of a network that is trained and measured on captures."""
    network, pipeline = small_network(0).to(device), CapturePipeline(camera(device))
    settings = TrainingSettings(epochs=1, learning_rate=1e-2, batch_size=10)
    training.fit(network, data(device), settings, 0, "test", pipeline.one_field)
    tensors = vars(evaluation.evaluate(network, data(device), pipeline)).values()
    assert {tensor.device for tensor in tensors} == {CPU}  # results come back to the CPU for writing
    return [value for tensor in tensors for value in tensor.flatten().float().tolist()]


def restoring(device, start) -> list[float]:
    """PSNRs of the validations."""
    pipelines = CapturePipeline(camera(device)), CapturePipeline(camera(device))
    _, history = restoration.train(NAFNET, data(device), data(device), *pipelines, 0)
    return [row["psnr_db"] for row in history]


def design(device, start) -> list[float]:
    """A lens after steps of joint descent; rays stay on the CPU."""
    problem = Problem(VIEW, LIMITS, 1, CaptureSettings(), data(device, 8))
    part = DescentSettings(optimizer="adamw", steps=3, learning_rates=LEARNING_RATES, network_learning_rate=1e-5)
    criterion = JointTaskLoss(small_network(0).to(device), 1e-5, 3, 0.1)
    lens, _, history = by_descents(start, lambda part: criterion, problem, part)
    assert lens.curvature.device == CPU
    return [*lens.curvature.tolist(), *lens.thickness.tolist(), *(row["loss"] for row in history)]


def supervision(device, start) -> list[float]:
    """Losses of a lens by a frozen network, and their gradient at the PSFs."""
    problem = Problem(VIEW, LIMITS, 1, CaptureSettings(), data(device))
    objective = Objective(TaskLoss(frozen(small_network(0), data(device).images).to(device)), problem, None, False, 7)
    curvature = start.curvature.clone().requires_grad_()
    loss = objective.loss(replace(start, curvature=curvature), sobol_disc(64, seed=0), 2.0, torch.arange(4), seed=0)
    (gradient,) = torch.autograd.grad(loss.value, curvature)
    assert loss.fields.device == gradient.device == CPU and gradient.dtype == curvature.dtype
    return [*loss.fields.tolist(), *gradient.tolist(), objective.validation_loss(start, 2.0)]


def without_mode(function):
    """Return a function that runs only on the CPU: torch crashes at derivatives by `jvp` on the pretended GPU."""

    def called(*arguments):
        with _disable_current_modes():
            return function(*arguments)

    return called


def ranking(device, start) -> list[float]:
    """Accuracies of a network through a lens and on the sharp images."""
    images = random_images(4, 16, 3, 0)  # too few to tell an untrained network from guessing
    pairs = [(image.float() / 255, int(label)) for image, label in zip(images.images, images.labels, strict=True)]
    with pytest.MonkeyPatch.context() as patch:
        for name in ("means", "paraxial"):
            patch.setattr(api_ranking, name, without_mode(getattr(api_ranking, name)))
        result = tasklens.rank({"start": (start, VIEW)}, pairs, small_network(0).to(device), rays=64)
    return [result.sharp, *result.correct["start"].to_numpy().ravel().tolist()]


@without_gpu
@pytest.mark.parametrize("calculation", [fine_tuning, restoring, design, supervision, ranking])
def test_the_code_for_gpus_gives_the_same_numbers(monkeypatch, start, calculation):
    expected = calculation(CPU, start)
    with pretend_gpu(monkeypatch) as gpu:
        numbers = calculation(GPU, start)
    assert numbers == expected and gpu.operations > 100


@with_gpu
@pytest.mark.parametrize("calculation, tolerance", [(restoring, 1e-3), (design, 0.05), (supervision, 1e-5)])
def test_a_real_gpu_gives_nearly_the_same_numbers(start, calculation, tolerance):
    """Relative to the norm of all numbers: rounding, multiplied by three steps of AdamW in a design."""
    expected, numbers = (torch.tensor(calculation(device, start), dtype=torch.float64) for device in (CPU, GPU))
    assert float((numbers - expected).norm() / expected.norm()) < tolerance


@without_gpu
def test_the_pretended_gpu_refuses_what_a_real_one_refuses(monkeypatch):
    """It refuses tensors of two devices and a CPU generator; it accepts CPU scalars and indices."""
    with pretend_gpu(monkeypatch):
        here, there = torch.ones(3), torch.ones(3).to(GPU)
        assert isinstance(there, OnGpu) and there.device == GPU and there.cpu().device == CPU
        for call in (
            lambda: here + there,
            lambda: torch.cat([here, there]),
            lambda: torch.nn.Linear(3, 1)(there),
            lambda: there.normal_(generator=torch.Generator()),
        ):
            with pytest.raises(RuntimeError, match="expected"):
                call()
        assert (there * torch.tensor(2.0)).tolist() == [2, 2, 2]
        assert there[torch.tensor([0, 1])].shape == (2,) and there[[0, 2]].device == GPU
        there[1] = 5
        assert there.cpu().tolist() == [1, 5, 1] and here.tolist() == [1, 1, 1]
