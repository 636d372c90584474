"""A doublet for a network, from flat plates: the loss of a frozen classifier flows into a lens. A minute and a half.

The studies go on with some 4000 steps, to the pixels of the sensor.
"""

from dataclasses import replace

import timm
import torch
from torch.nn.functional import cross_entropy

import tasklens
from tasklens.camera.imaging import PsfCamera
from tasklens.design.descent import geometric
from tasklens.design.optimizers import RaySpaceOptimizer
from tasklens.design.problem import Problem
from tasklens.design.start import flat
from tasklens.materials.catalogues import builtin
from tasklens.optics.view import drawn_points, view_of_spec
from tasklens.recognition import scenes, training
from tasklens.recognition.dataset import ImageDataset
from tasklens.settings.design_settings import DescentSettings
from tasklens.settings.network_settings import TrainingSettings
from tasklens.settings.specification import Constraints, Spec

LIMITS = Constraints()
SETTINGS = DescentSettings(  # pixels shrink from 20 to 4 times the sensor's: plates blur everything
    optimizer="ray_space",
    steps=300,
    pixels=(20, 4),
    duration=0.7,
    step_size=0.4,
    momentum=0.95,
    final=0.05,
    centre="chief_ray",
)


def descend(start, view, network, batches, settings=SETTINGS, rays=128):
    """Yield the lens and its loss before each step; a step moves rays on the sensor by a given distance."""
    first, last = settings.pixels
    optimizer = RaySpaceOptimizer(start, Problem(view, LIMITS, 0), settings)
    for step, (images, labels) in enumerate(batches):
        fraction = step / settings.steps
        pixels = last * geometric(first / last, fraction / settings.duration)
        vector = optimizer.vector()  # curvatures, thicknesses, coefficients
        lens = optimizer.lens(vector)
        drawn = view.at(drawn_points(1, seed=step))  # new fields in each step: no lens is fitted to a few
        psf = tasklens.psf(lens, replace(drawn, pixel_pitch_um=pixels * view.pixel_pitch_um), rays)
        captures = PsfCamera(psf.float()).all_fields(images)  # (field, image, colour, y, x)
        loss = cross_entropy(network(captures.flatten(0, 1)), labels.repeat(len(captures)))
        yield lens.detached(), loss.item()
        optimizer.apply(optimizer.change(vector, lens, loss, fraction, pixels))  # within the limits


def network_and_batches(steps, epochs=6):
    """Train a network on sharp textures, freeze it, and draw images for each step."""
    torch.manual_seed(0)
    dataset = ImageDataset(*scenes.render(2000, 64, seed=0), scenes.CLASSES)
    network = timm.create_model("test_resnet", num_classes=len(dataset.classes))
    training.fit(network, dataset, TrainingSettings(epochs=epochs, learning_rate=3e-3), 0, "network")
    return network.requires_grad_(False), [dataset.batch(torch.randint(len(dataset), (8,))) for _ in range(steps)]


def main(settings=SETTINGS, epochs=6):
    """Design a lens for a network."""
    plates, view = flat((builtin("COC"), builtin("OKP4")), Spec(), LIMITS), view_of_spec(Spec())
    network, batches = network_and_batches(settings.steps, epochs)
    for step, (lens, loss) in enumerate(descend(plates, view, network, batches, settings)):
        if step % 20 == 0:
            print(f"step {step}: loss {loss:.2f}, axial spot {1e3 * tasklens.trace(lens, view).x[0].std():.0f} um")
    tasklens.save_lens("task_driven.yaml", lens, view)


if __name__ == "__main__":
    main()
