"""GPU code paths: on a pretended GPU devices never mix and numbers equal those of the CPU; on a real one, nearly.

Tensors on the pretended GPU say that they are there, compute on the CPU, and refuse to mix with others. CUDA refuses an
operation on tensors of two devices, except for scalars (tensors without dimensions) on the CPU, and indices; so does
the pretended GPU, which finds errors that no run on a CPU finds: a tensor not moved to the GPU, a result not copied
back, a generator on the other device. It does not cover half precision.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
import torch
from designs import LEARNING_RATES, LIMITS, VIEW
from examples import by_descents, random_images, small_network
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map, tree_unflatten

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


# ---- the pretended GPU

GPU = torch.device("cuda", 0)
CPU = torch.device("cpu")
aten = torch.ops.aten
# Operations that copy between devices, and operations that take indices or values of the CPU.
COPIES = {aten._to_copy.default, aten.copy_.default, aten._local_scalar_dense.default}
LAZY = {aten._conj.default: aten.conj_physical.default, aten._neg_view.default: aten.neg.default}  # but for marks
INDEXED = {aten.index.Tensor, aten.index_put_.default, aten.index_put.default, aten._index_put_impl_.default}


class OnGpu(torch.Tensor):
    """A tensor on the GPU, with its values on the CPU in `values`."""

    values: torch.Tensor

    @staticmethod
    def __new__(cls, values: torch.Tensor) -> "OnGpu":
        # On the meta device for torch, which would ask a driver about a tensor on a GPU.
        tensor = torch.Tensor._make_wrapper_subclass(
            cls, values.shape, values.stride(), values.storage_offset(), dtype=values.dtype, device="meta"
        )
        tensor.values = values
        return tensor

    @property
    def device(self) -> torch.device:
        return GPU

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        raise AssertionError("a tensor of the GPU outlives it")

    def __getitem__(self, index):
        parts = index if isinstance(index, tuple) else (index,)  # a list would become a tensor of no values
        return super().__getitem__(tuple(torch.tensor(part) if isinstance(part, list) else part for part in parts))

    def tolist(self) -> object:  # torch's own method refuses other classes
        return self.values.tolist()

    def pin_memory(self, *_):
        raise RuntimeError("cannot pin 'torch.cuda.FloatTensor', only dense CPU tensors can be pinned")


class PretendGpu(TorchDispatchMode):
    """While this mode is active, tensors can be on the GPU; `operations` counts the operations that ran there."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        flat, tree = tree_flatten((args, kwargs or {}))
        tensors = [value for value in flat if isinstance(value, torch.Tensor)]
        gpu_tensors = [value for value in tensors if isinstance(value, OnGpu)]
        cpu_tensors = [value for value in tensors if not isinstance(value, OnGpu) and value.dim() > 0]
        if gpu_tensors and cpu_tensors and function not in COPIES | INDEXED:
            shapes = ", ".join(str(tuple(value.shape)) for value in cpu_tensors)
            raise RuntimeError(f"{function}: expected all tensors on {GPU}, found {shapes} on the CPU")
        generators = [value for value in flat if isinstance(value, torch.Generator)]
        target = (kwargs or {}).get("device")
        on_gpu = bool(gpu_tensors) if target is None else torch.device(target).type in (GPU.type, "meta")
        if function is aten.copy_.default:
            on_gpu = isinstance(args[0], OnGpu)
        if on_gpu and any(value.device == CPU for value in generators):
            raise RuntimeError(f"{function}: expected a generator of {GPU}, found one of the CPU")
        values = [value.values if isinstance(value, OnGpu) else value for value in flat]
        values = [CPU if isinstance(value, torch.device) else value for value in values]
        args, kwargs = tree_unflatten(values, tree)
        result = LAZY.get(function, function)(*args, **kwargs)
        self.operations += on_gpu
        wrappers = {id(value.values): value for value in gpu_tensors}
        return tree_map(lambda value: self._placed(value, on_gpu, wrappers), result)

    @staticmethod
    def _placed(value, on_gpu: bool, wrappers: dict[int, OnGpu]):
        if not isinstance(value, torch.Tensor) or not on_gpu:
            return value
        wrapper = wrappers.get(id(value))  # a tensor changed in place keeps its wrapper
        return OnGpu(value) if wrapper is None else wrapper


@contextmanager
def pretend_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[PretendGpu]:
    """Pretend that there is a GPU while the block runs."""
    monkeypatch.setattr(torch.cuda, "_lazy_init", lambda: None)
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda self, *_: self)
    before = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(
        True
    )  # otherwise a moved network keeps its old parameters
    try:
        with PretendGpu() as gpu:
            yield gpu
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(before)


# ---- calculations on either device


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
