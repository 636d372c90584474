"""Draw one photograph, sharp and through four doublets, with the accuracies of the study `photographs_sensor`.

    python docs/results/photograph.py kodim06.png

The photograph is of Kodak's set (free use). Captures are at one field, as in the study, of 224 x 224 pixels.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pandas
from PIL import Image

import tasklens

FOLDER = Path(__file__).parent
STUDY = FOLDER / "photographs_sensor"
LENSES = {
    "by least squares": "imaging2",
    "for PSNR": "image_psnr",
    "for correlation": "image_centre",  # the best for image quality
    "by a frozen network": "tasklens",
}
FIELD = (1.0, 0.56)  # [mm]; 57 % of the corner's radius


def main() -> None:
    """Write photograph.webp."""
    photograph = Image.open(sys.argv[1]).convert("RGB").resize((224, 224))
    table = pandas.read_csv(STUDY / "table1.csv").set_index("design")
    panels = [("sharp", photograph, table.loc["reference", "accuracy"])]
    for name, design in LENSES.items():
        lens, view = tasklens.load_lens(STUDY / "lenses" / f"doublet-{design}.yaml")
        capture = tasklens.simulate(lens, view, photograph, fields=[FIELD])[0]
        panels.append((f"designed {name}", capture.permute(1, 2, 0).clamp(0, 1), table.loc[design, "accuracy"]))
    figure, axes = plt.subplots(1, len(panels), figsize=(13, 3.1), layout="constrained")
    for axis, (title, image, accuracy) in zip(axes, panels, strict=True):
        axis.imshow(image)
        axis.set(title=title, xlabel=f"recognised: {accuracy:.1f} %", xticks=[], yticks=[])
    figure.savefig(FOLDER / "photograph.webp", dpi=110)


if __name__ == "__main__":
    main()
