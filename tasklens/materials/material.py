"""Optical materials: dispersion formulas, their coefficients, and the wavelength range of the fit.

The formulas are those of Zemax's glass catalogues (OpticStudio user's guide, "The Glass Dispersion Formulas"), in the
order of their numbers, and `model` for a glass with only nd, Vd and dPgF.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from tasklens.runtime.errors import InputError
from tasklens.runtime.files import FileError, number

G_LINE, F_LINE, D_LINE, C_LINE = 0.4358343, 0.4861327, 0.5875618, 0.6562725  # [um]
LEAST_INDEX = 0.9995  # indices are relative to air, in which vacuum has 0.9997: no lens is made of less
MOST_INDEX = 6.0  # lead telluride has 5.7 in the infrared

Index = Callable[[tuple[float, ...], float], float]


def _powers(*powers: int) -> Index:
    """Return the formula n^2 = sum_i c_i w^p_i with the powers p_i."""
    return lambda c, w: math.sqrt(sum(a * w**p for a, p in zip(c, powers, strict=True)))


def _sellmeier(c: tuple[float, ...], w: float) -> float:
    """Compute n from n^2 = 1 + sum_i K_i w^2 / (w^2 - L_i); c = K_1, L_1, K_2, L_2 .."""
    return math.sqrt(1 + sum(k * w * w / (w * w - l) for k, l in zip(c[::2], c[1::2], strict=True)))


def _herzberger(c: tuple[float, ...], w: float) -> float:
    """Compute n = c0 + c1 L + c2 L^2 + c3 w^2 + c4 w^4 + c5 w^6, L = 1 / (w^2 - 0.028)."""
    l = 1 / (w * w - 0.028)
    return c[0] + c[1] * l + c[2] * l**2 + c[3] * w**2 + c[4] * w**4 + c[5] * w**6


def _model(c: tuple[float, ...], w: float) -> float:
    """Compute Conrady's n = a + b / w + e / w^3.5 with a, b and e from nd, Vd and dPgF.

    nF - nC = (nd - 1) / Vd and ng - nF = (nF - nC) (0.6438 - 0.001682 Vd + dPgF), the normal line through K7 and F2
    (Schott TIE-29). OpticStudio's formula for its model glass is not published; its stated accuracy is 1e-4 in the
    visible, which this formula reaches for 90 % of Schott's catalogue with the dPgF of each glass.
    """
    nd, vd, dpgf = c
    if not vd:
        return nd  # Zemax's convention for no dispersion
    dispersion = (nd - 1) / vd
    partial = 0.6438 - 0.001682 * vd + dpgf
    u = {line: 1 / line for line in (G_LINE, F_LINE, D_LINE, C_LINE)}
    v = {line: line**-3.5 for line in u}
    u_fc, v_fc = u[F_LINE] - u[C_LINE], v[F_LINE] - v[C_LINE]
    u_gf, v_gf = u[G_LINE] - u[F_LINE], v[G_LINE] - v[F_LINE]
    scale = dispersion / (u_fc * v_gf - u_gf * v_fc)
    b, e = scale * (v_gf - partial * v_fc), scale * (partial * u_fc - u_gf)
    return nd + b * (1 / w - u[D_LINE]) + e * (w**-3.5 - v[D_LINE])


# Name: number of coefficients, and index as a function of the coefficients and the wavelength w [um].
FORMULAS: dict[str, tuple[int, Index]] = {
    "schott": (6, _powers(0, 2, -2, -4, -6, -8)),
    "sellmeier_1": (6, _sellmeier),
    "herzberger": (6, _herzberger),
    "sellmeier_2": (
        5,
        lambda c, w: math.sqrt(1 + c[0] + c[1] * w * w / (w * w - c[2] ** 2) + c[3] / (w * w - c[4] ** 2)),
    ),
    "conrady": (3, lambda c, w: c[0] + c[1] / w + c[2] / w**3.5),
    "sellmeier_3": (8, _sellmeier),
    "handbook_1": (4, lambda c, w: math.sqrt(c[0] + c[1] / (w * w - c[2]) - c[3] * w * w)),
    "handbook_2": (4, lambda c, w: math.sqrt(c[0] + c[1] * w * w / (w * w - c[2]) - c[3] * w * w)),
    "sellmeier_4": (5, lambda c, w: math.sqrt(c[0] + w * w * (c[1] / (w * w - c[2]) + c[3] / (w * w - c[4])))),
    "extended": (8, _powers(0, 2, -2, -4, -6, -8, -10, -12)),
    "sellmeier_5": (10, _sellmeier),
    "extended_2": (8, _powers(0, 2, -2, -4, -6, -8, 4, 6)),
    "extended_3": (9, _powers(0, 2, 4, -2, -4, -6, -8, -10, -12)),
    "model": (3, _model),
}


_FAR_INFRARED = 100.0  # um; a larger number is a wavelength in nm


@dataclass(frozen=True)
class Material:
    """An optical material.

    Attributes:
        name: name in elements and lens files.
        formula: one of `FORMULAS`.
        coefficients: coefficients of the formula, for wavelengths in um.
        range_um: shortest and longest wavelength of the fit [um].
        source: source of the coefficients.
        zemax: its catalogue and name in OpticStudio, such as `MISC POLYSTYR`; empty if it is not there.
    """

    name: str
    formula: str
    coefficients: tuple[float, ...]
    range_um: tuple[float, float]
    source: str = ""
    zemax: str = ""

    def __post_init__(self) -> None:
        if self.formula not in FORMULAS:
            raise ValueError(f"{self.name}: unknown formula {self.formula!r}; expected one of {', '.join(FORMULAS)}")
        count = FORMULAS[self.formula][0]
        if len(self.coefficients) != count:
            raise ValueError(f"{self.name}: {self.formula} has {count} coefficients, got {len(self.coefficients)}")
        if not 0 <= self.range_um[0] < self.range_um[1]:
            raise ValueError(f"{self.name}: expected a range of rising wavelengths, got {self.range_um}")
        if self.range_um[0] > _FAR_INFRARED:
            raise ValueError(f"{self.name}: range_um: expected um, got {self.range_um}, which seem to be nm")
        if self.zemax and len(self.zemax.split()) != 2:
            raise ValueError(
                f"{self.name}: zemax: expected a catalogue and a name, such as MISC PMMA, got {self.zemax}"
            )

    def covers(self, wavelength: float) -> bool:
        """Return whether `wavelength` [um] is in the range of the fit."""
        return self.range_um[0] <= wavelength <= self.range_um[1]

    def refractive_index(self, wavelength: float) -> float:
        """Compute the refractive index at `wavelength` [um], relative to air.

        Raises:
            InputError: the wavelength is outside the fitted range, or the coefficients give no index in [`LEAST_INDEX`,
                `MOST_INDEX`) there.
        """
        if not self.covers(wavelength):
            low, high = self.range_um
            hint = "; wavelengths are in um, such as 0.55" if wavelength > _FAR_INFRARED else ""
            raise InputError(
                f"{self.name}: wavelength {wavelength} um is outside the fitted range {low} to {high} um{hint}"
            )
        try:
            index = FORMULAS[self.formula][1](self.coefficients, wavelength)
        except (ValueError, ArithmeticError):
            raise InputError(f"{self.name}: its coefficients give no index at {wavelength} um") from None
        if not LEAST_INDEX <= index < MOST_INDEX:
            raise InputError(
                f"{self.name}: its coefficients give the index {index:.6g} at {wavelength} um; expected at least 1,"
                f" relative to air, and less than {MOST_INDEX:g}: correct the coefficients"
            )
        return index

    def abbe(self) -> tuple[float, float]:
        """Compute nd and Vd = (nd - 1) / (nF - nC); zeros if the fit does not cover F, d and C."""
        lines = F_LINE, D_LINE, C_LINE
        if not all(map(self.covers, lines)):
            return 0.0, 0.0
        nf, nd, nc = map(self.refractive_index, lines)
        return nd, (nd - 1) / (nf - nc) if nf != nc else 0.0

    def definition(self) -> dict:
        """Return the entry of the material in a YAML file, without its name."""
        return {
            "formula": self.formula,
            "coefficients": list(self.coefficients),
            "range_um": list(self.range_um),
            "source": self.source,
            **({"zemax": self.zemax} if self.zemax else {}),
        }


AIR = Material("air", "schott", (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, math.inf))


def model_glass(nd: float, vd: float, dpgf: float, label: str = "") -> Material:
    """Return a glass of nd, Vd and dPgF, valid in the visible; `label`, without spaces, begins its name.

    Vd = 0 is Zemax's convention for an index that is the same at every wavelength.
    """
    numbers = "/".join(repr(value) for value in (nd, vd, dpgf)[: 3 if dpgf else 2])
    range_um = (0.38, 0.78) if vd else (0.0, 1000.0)
    return Material(f"{label} {numbers}".strip(), "model", (nd, vd, dpgf), range_um, "nd, Vd and dPgF")


def short_name(material: Material) -> str:
    """Return the name of a material for display; a model glass has nd and Vd rounded as in data sheets."""
    if material.formula != "model":
        return material.name
    nd, vd, _ = material.coefficients
    own = f"{material.name.partition(' ')[0]} " if " " in material.name else ""
    return f"{own}{nd:.4g}/{vd:.3g}"


def from_definitions(content: object, where: str) -> dict[str, Material]:
    """Read materials by name from the content of a YAML file.

    Raises:
        FileError: incomplete or invalid definitions; the message begins with `where` and the material's name.
    """
    if not isinstance(content, Mapping):
        raise FileError(f"{where}: expected materials by name, found {type(content).__name__}")
    return {name: _material(name, entry, where) for name, entry in content.items()}


def _material(name: object, entry: object, where: str) -> Material:
    if not isinstance(name, str) or not name or name == AIR.name:
        raise FileError(f"{where}: {name!r} cannot be the name of a material")
    where = f"{where}: {name}"
    keys = ("formula", "coefficients", "range_um", "source", "zemax")
    if not isinstance(entry, Mapping):
        raise FileError(f"{where}: expected the keys {', '.join(keys)}, found {entry!r}")
    wrong = [f"{key!r} is unknown" for key in entry if key not in keys]
    if wrong := [*wrong, *(f"{key} is missing" for key in keys[:3] if key not in entry)]:
        raise FileError(f"{where}: {', '.join(wrong)}; expected the keys {', '.join(keys)}")
    for key in ("coefficients", "range_um"):
        if not isinstance(entry[key], list | tuple):
            raise FileError(f"{where}: {key}: expected a list of numbers, found {entry[key]!r}")
    if len(entry["range_um"]) != 2:
        raise FileError(f"{where}: range_um: expected two wavelengths, found {entry['range_um']!r}")
    coefficients = tuple(number(value, f"{where}: coefficients") for value in entry["coefficients"])
    low, high = (number(value, f"{where}: range_um") for value in entry["range_um"])
    try:
        words = (str(entry.get(key, "")) for key in ("source", "zemax"))
        return Material(name, str(entry["formula"]), coefficients, (low, high), *words)
    except ValueError as error:
        raise FileError(f"{where.removesuffix(name)}{error}") from None
