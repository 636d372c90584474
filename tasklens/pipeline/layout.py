"""Where the files of a study are; the arguments may also be Snakemake wildcards such as "{lens}"."""

from dataclasses import dataclass
from pathlib import Path

from tasklens.study.study import Study

PAPER = str(Path(__file__).parents[1] / "report" / "paper.csv")  # the values that the paper prints
SHARP = "sharp"  # stands where a lens name stands, for a classifier that sees the pictures themselves


@dataclass(frozen=True)
class Layout:
    """Paths below `root`, the results folder of one study."""

    root: str

    @classmethod
    def of(cls, study: Study) -> "Layout":
        return cls(f"results/{study.name}")

    @property
    def study(self) -> str:
        return f"{self.root}/study.yaml"

    def images(self, split: str) -> str:
        return f"{self.root}/images/{split}.safetensors"

    def reference(self, classifier: str) -> str:
        return f"{self.root}/classifiers/reference/{classifier}.safetensors"

    def lens(self, lens: str, seed: int | str) -> str:
        return f"{self.root}/lenses/{lens}/seed{seed}/lens.yaml"

    def history(self, lens: str, seed: int | str) -> str:
        return f"{self.root}/lenses/{lens}/seed{seed}/history.csv"

    def certificate(self, lens: str, seed: int | str) -> str:
        return f"{self.root}/lenses/{lens}/seed{seed}/certificate.md"

    def psf(self, lens: str, seed: int | str) -> str:
        return f"{self.root}/lenses/{lens}/seed{seed}/psf.safetensors"

    def tail(self, lens: str, seed: int | str) -> str:
        return f"{self.root}/lenses/{lens}/seed{seed}/psf_tail.csv"

    def encircled_energy(self, lens: str, seed: int | str) -> str:
        return f"{self.root}/lenses/{lens}/seed{seed}/encircled_energy.csv"

    def classifier(self, lens: str, seed: int | str, classifier: str) -> str:
        return f"{self.root}/classifiers/{lens}/seed{seed}/{classifier}.safetensors"

    def metrics(self, lens: str, seed: int | str, classifier: str) -> str:
        return f"{self.root}/metrics/{lens}/seed{seed}/{classifier}.csv"

    def pictures(self, lens: str, seed: int | str, classifier: str) -> str:
        return f"{self.root}/metrics/{lens}/seed{seed}/{classifier}-pictures.csv"

    def reproduced(self, lens: str, seed: int | str, classifier: str) -> str:
        return f"{self.root}/verification/{lens}/seed{seed}/{classifier}-pictures.csv"

    def restoration(self, lens: str, seed: int | str) -> str:
        return f"{self.root}/restoration/{lens}/seed{seed}/nafnet.safetensors"

    def restoration_history(self, lens: str, seed: int | str) -> str:
        return f"{self.root}/restoration/{lens}/seed{seed}/history.csv"

    def checkpoint(self, stage: str, name: str, key: str) -> str:
        return f"{self.root}/checkpoints/{stage}-{name}-{key}.pt"

    def table(self, table: str, suffix: str) -> str:
        return f"{self.root}/tables/{table}.{suffix}"

    def ablation(self, ablation: str, suffix: str) -> str:
        return self.table(f"ablation_{ablation}", suffix)

    def figure(self, lens: str, seed: int | str) -> str:
        return f"{self.root}/figures/{lens}-seed{seed}.png"

    def comparison(self, elements: str, seed: int | str) -> str:
        return f"{self.root}/figures/figure3-{elements}-seed{seed}.png"


def restored(classifier: str) -> str:
    """Name of a classifier that sees restored captures."""
    return f"{classifier}-restored"
