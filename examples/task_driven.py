"""A doublet for a network, from flat plates: the loss of a frozen classifier flows into a lens. A minute and a half."""

from dataclasses import replace

import timm
import torch
from torch.nn.functional import cross_entropy

import tasklens
from tasklens.camera.imaging import PsfCamera
from tasklens.design.constraints import penalty
from tasklens.design.start import flat
from tasklens.materials.catalogues import builtin
from tasklens.optics.view import drawn_points, view_of_spec
from tasklens.recognition import scenes, training
from tasklens.recognition.dataset import ImageDataset
from tasklens.settings.network_settings import TrainingSettings
from tasklens.settings.specification import Constraints, Spec

LIMITS = Constraints()


def descend(start, view, network, batches, learning_rate=4e-3, coarsest=20.0, rays=256):
    """Yield the lens and its loss before each step of AdamW; pixels shrink from `coarsest` to the sensor's."""
    curvature = start.curvature[1:].clone().requires_grad_()  # [1/mm]; surface 0 is the stop
    thickness = start.thickness[1:].clone().requires_grad_()  # [mm]
    alpha = start.alpha[1:, 1:].clone().requires_grad_()  # of r^4 .. r^10
    optimizer = torch.optim.AdamW([curvature, thickness, alpha], lr=learning_rate, weight_decay=0.0)
    for step, (images, labels) in enumerate(batches):
        lens = replace(
            start,
            curvature=torch.cat([start.curvature[:1], curvature]),
            thickness=torch.cat([start.thickness[:1], thickness]),
            alpha=torch.cat([start.alpha[:1], torch.cat([start.alpha[1:, :1], alpha], 1)]),
        )
        pixels = coarsest ** max(0.0, 1 - step / (0.8 * len(batches)))
        drawn = view.at(drawn_points(1, seed=step))  # new fields in each step: no lens is fitted to a few
        coarse = replace(drawn, pixel_pitch_um=pixels * view.pixel_pitch_um)
        psf = tasklens.psf(lens, coarse, rays)  # (field, colour, y, x)
        captures = PsfCamera(psf.float()).all_fields(images)  # (field, image, colour, y, x)
        loss = cross_entropy(network(captures.flatten(0, 1)), labels.repeat(len(captures)))
        yield lens.detached(), loss.item()
        optimizer.zero_grad()
        (loss + 100 * penalty(lens, LIMITS, view)).backward()
        optimizer.step()


def main(steps=300):
    """Train a network on sharp textures, freeze it, and design a lens for it."""
    plates, view = flat((builtin("COC"), builtin("OKP4")), Spec(), LIMITS), view_of_spec(Spec())
    dataset = ImageDataset(*scenes.render(2000, 64, seed=0), scenes.CLASSES)
    network = timm.create_model("test_resnet", num_classes=len(dataset.classes))
    training.fit(network, dataset, TrainingSettings(epochs=6, learning_rate=3e-3), 0, "network")
    network.requires_grad_(False)
    batches = [dataset.batch(torch.randint(len(dataset), (8,))) for _ in range(steps)]
    for step, (lens, loss) in enumerate(descend(plates, view, network, batches)):
        if step % 20 == 0:
            print(f"step {step}: loss {loss:.2f}, axial spot {1e3 * tasklens.trace(lens, view).x[0].std():.0f} um")
    tasklens.save_lens("task_driven.yaml", lens, view)


if __name__ == "__main__":
    main()
