"""Conversion between surfaces of Zemax lens files and lenses."""

import math
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import torch

from tasklens.materials.library import Library, UnknownGlassError, nearest
from tasklens.materials.material import AIR, Material, model_glass
from tasklens.materials.zemax_text import BLANK, Line, decimal
from tasklens.optics.io.zemax_keywords import check_aperture
from tasklens.optics.lens import Lens

_TERMS = 8  # terms of an even asphere, alpha_2 .. alpha_16; more need the extended asphere
_MOST_TERMS = 240  # terms of an extended asphere
_KINDS = ("STANDARD", "EVENASPH", "XASPHERE", "ODDASPHE", "XOSPHERE")
_PARAMETERS = 12  # of an extended asphere in PARM; those behind are its number of terms and normalisation radius
_HEAD = 2  # number of values of an extended asphere before its coefficients
_NO_DATA = 1.5, 40.0  # nd and Vd that OpticStudio writes for any glass of a catalogue


@dataclass(frozen=True)
class Block:
    """The lines of one surface: the last one of each keyword, and numbered lines (PARM, XDAT) by their number."""

    head: Line
    lines: dict[str, Line]
    numbered: dict[tuple[str, int], Line]

    def line(self, keyword: str) -> Line:
        """Return the line of `keyword`; raises FileError if there is none."""
        if keyword not in self.lines:
            raise self.head.error(f"surface {self.head.text} has no {keyword}")
        return self.lines[keyword]

    def number(self, keyword: str, default: float) -> float:
        """Return the first number after `keyword`, or `default`."""
        return self.lines[keyword].number(0) if keyword in self.lines else default


def to_lens(blocks: list[Block], stop: int, unit: float, library: Library) -> tuple[Lens, list[str]]:
    """Convert the surfaces between object and image to a lens.

    Args:
        blocks: lines of the surfaces.
        stop: index of the stop.
        unit: the file's unit of length [mm].
        library: glasses by name.

    Returns:
        The lens, and the assumptions about its glasses and aspheres, as text.

    Raises:
        FileError: an invalid or unsupported surface.
    """
    remarks: list[str] = []
    aspheres = [_asphere(block, unit, remarks) for block in blocks]
    orders = max(len(coefficients) for coefficients in aspheres)
    media: list[Material] = []
    for block in blocks:
        media.append(_medium(block, media, library, remarks))
    refracts = [before != after for before, after in pairwise([AIR, *media])]

    def column(values: Iterable[float | list[float]]) -> torch.Tensor:
        return torch.tensor(list(values), dtype=torch.float64)

    lens = Lens(
        curvature=column(block.line("CURV").number(0) / unit for block in blocks),
        conic=column(block.number("CONI", 0.0) for block in blocks),
        alpha=column([*a, *[0.0] * (orders - len(a))] for a in aspheres).reshape(len(blocks), orders),
        thickness=column(block.line("DISZ").number(0, unit) for block in blocks),
        semi_diameter=column(_clear_radius(*pair, unit) for pair in zip(blocks, refracts, strict=True)),
        media=tuple(media),
        stop=stop,
    )
    return lens, list(dict.fromkeys([*library.remarks, *remarks]))


def _asphere(block: Block, unit: float, remarks: list[str]) -> list[float]:
    """Read the coefficients from alpha_2 to the last one that is not zero [mm^(1 - 2j)]; add assumptions to `remarks`.

    An even asphere has alpha_2j in PARM j. An extended asphere, sum_j a_j (r / rho)^2j, has the number of terms in
    XDAT 1, the radius rho in XDAT 2, and a_j in XDAT 2 + j; without terms, some converters write it as an even asphere.
    An odd asphere, with terms (r / rho)^j, is read if all of its odd terms are zero.
    """
    kind = block.lines["TYPE"].text if "TYPE" in block.lines else "STANDARD"
    rho, keys = 1.0, []
    if kind in ("EVENASPH", "ODDASPHE"):
        keys = [("PARM", j) for j in range(1, _TERMS + 1)]
    elif kind in ("XASPHERE", "XOSPHERE"):
        terms, rho = _normalisation(block)
        keys = [("XDAT", _HEAD + j) for j in range(1, terms + 1)]
        parameters = [("PARM", j) for j in range(1, _PARAMETERS + 1)]
        given = any(block.numbered[key].number(1) for key in parameters if key in block.numbered)
        if given and not terms and kind == "XASPHERE":
            keys = parameters
            remarks.append(
                f"surface {block.head.text} is an XASPHERE without terms in XDAT: PARM is read as of EVENASPH"
            )
    elif kind != "STANDARD":
        raise block.lines["TYPE"].error(f"{kind} is not supported; expected one of {', '.join(_KINDS)}")
    head = [("XDAT", j) for j in range(1, _HEAD + 1)] if kind in ("XASPHERE", "XOSPHERE") else []
    for key, line in block.numbered.items():
        if key not in keys and key not in head and line.number(1):
            raise line.error(
                f"{kind} with {len(keys)} terms has no term number {key[1]}; delete the line, or correct the type"
            )
    if kind in ("ODDASPHE", "XOSPHERE"):
        for key in keys[::2]:
            if key in block.numbered and block.numbered[key].number(1):
                raise block.numbered[key].error("odd terms of aspheres are not supported, only even ones")
        keys = keys[1::2]
    coefficients = [
        _coefficient(block.numbered[key], j, rho, unit) if key in block.numbered else 0.0
        for j, key in enumerate(keys, 1)
    ]
    while coefficients and not coefficients[-1]:
        coefficients.pop()
    return coefficients


def _normalisation(block: Block) -> tuple[int, float]:
    """Read the number of terms of an extended asphere and its normalisation radius, in the file's unit."""
    count, radius = (block.numbered.get(("XDAT", number)) for number in range(1, _HEAD + 1))
    terms = 0 if count is None else count.integer(1)
    if count is not None and not 0 <= terms <= _MOST_TERMS:
        raise count.error(f"expected 0 .. {_MOST_TERMS} terms, found {count.words[1]}")
    if not terms:
        return 0, 1.0
    if radius is None:
        raise block.lines["TYPE"].error(f"expected the normalisation radius of {terms} terms in XDAT 2, found none")
    if not radius.number(1) > 0:
        raise radius.error(f"expected a positive normalisation radius, found {radius.words[1]}")
    return terms, radius.number(1)


def _coefficient(line: Line, j: int, rho: float, unit: float) -> float:
    """Convert coefficient j to alpha_2j = a / (rho^2j unit^(2j - 1)) [mm^(1 - 2j)]; raises FileError."""
    value = line.number(1)
    if not value or rho == unit == 1.0:
        return value
    try:
        alpha = value / rho ** (2 * j) / unit ** (2 * j - 1)
    except (OverflowError, ZeroDivisionError):
        alpha = math.inf
    if not sys.float_info.min <= abs(alpha) < math.inf:
        raise line.error(
            f"{line.words[1]} over {rho:g}^{2 * j} {unit:g}^{2 * j - 1} mm^{2 * j - 1} is beyond the range of float64"
        )
    return alpha


def _clear_radius(block: Block, refracts: bool, unit: float) -> float:
    """Read the radius of the clear aperture [mm]; infinite if Zemax does not vignette here.

    On surfaces that refract, a semi-diameter that is fixed or picked up is a floating aperture.
    """
    for line in block.lines.values():
        check_aperture(line)
    for keyword in ("CLAP", "FLAP"):
        if keyword in block.lines:
            aperture = block.lines[keyword]
            if aperture.number(0):
                raise aperture.error("the aperture has a hole; only full circles are supported")
            return _radius(aperture, 1, unit)
    if refracts and limits_rays(block.lines):
        return _radius(block.lines["DIAM"], 0, unit)
    return math.inf


def limits_rays(lines: Mapping[str, Line]) -> bool:
    """Return whether the solve of a semi-diameter is "fixed" or "pick-up", so that it may vignette."""
    return "DIAM" in lines and len(lines["DIAM"].words) > 1 and lines["DIAM"].integer(1) in (1, 2)


def _radius(line: Line, index: int, unit: float) -> float:
    """Read word `index` as a radius [mm]."""
    if line.number(index) < 0:
        raise line.error(f"expected a radius of at least 0, found {line.words[index]}")
    return line.number(index, unit)


def _medium(block: Block, before: list[Material], library: Library, remarks: list[str]) -> Material:
    """Read the medium behind a surface; assumptions are added to `remarks`.

    GLAS: a name, a solve (0 none, 1 model, 2 picked up from the surface in the next number, 3 substitution, 4 offset),
    nd, Vd, dPgF. The name of a model glass is only a label, but may also be a name in a catalogue. A glass that is in
    no catalogue is a model glass too, if its line has its own nd and Vd.
    """
    if "GLAS" not in block.lines:
        return AIR
    line = block.lines["GLAS"]
    name, solve = (line.words or [""])[0], line.integer(1) if len(line.words) > 1 else 0
    if name == "MIRROR":
        raise line.error("mirrors are not supported")
    if not 0 <= solve <= 3:
        raise line.error("index offsets of glasses are not supported")
    if solve == 2:
        source = line.integer(2)
        if not 1 <= source <= len(before):
            raise line.error(f"picked up from surface {source}, which is not in front of it")
        return before[source - 1]
    if solve == 1 or name == BLANK:
        nd, vd = line.number(3), line.number(4)
        dpgf = line.number(5) if len(line.words) > 5 else 0.0
        if nd < 1 or vd < 0:
            raise line.error(f"no model glass has nd = {nd} and Vd = {vd}")
        return model_glass(nd, vd, dpgf, "" if name == BLANK else name)
    try:
        return library.glass(name)
    except UnknownGlassError as error:
        nd, vd, dpgf = (line.number(i) if len(line.words) > i else 0.0 for i in (3, 4, 5))
        if nd <= 1 or vd <= 0 or (nd, vd) == _NO_DATA:
            raise line.error(str(error)) from None
        closest = nearest(nd, vd)
        remarks.append(
            f"glass {name} is in no catalogue: using a model glass with nd = {nd:g} and Vd = {vd:g}, as its line says; "
            f"for nine of ten glasses, its index is right to {'1e-4' if dpgf else '4e-4'} in the visible. The nearest "
            f"glass is {closest.zemax} (--catalogue)"
        )
        return model_glass(nd, vd, dpgf, name)


def to_lines(lens: Lens, index: int, comment: str, radius: float, names: Mapping[Material, str]) -> list[str]:
    """Convert surface `index` of a lens to lines [mm].

    Args:
        lens: the lens.
        index: index of the surface.
        comment: its comment, or an empty string.
        radius: radius of its clear aperture [mm], infinite if it has none.
        names: names of the glasses that are in catalogues.
    """
    alpha = lens.alpha[index].tolist()
    while alpha and not alpha[-1]:
        alpha.pop()
    lines = [f"  COMM {comment}"] if comment else []
    if index == lens.stop:
        lines.append("  STOP")
    kind = "STANDARD" if not alpha else "EVENASPH" if len(alpha) <= _TERMS else "XASPHERE"
    lines += [f"  TYPE {kind}", f'  CURV {decimal(float(lens.curvature[index]))} 0 0 0 0 ""']
    if kind == "EVENASPH":
        terms = [*alpha, *[0.0] * (_TERMS - len(alpha))]
        lines += [f"  PARM {j} {decimal(value)}" for j, value in enumerate(terms, 1)]
    elif kind == "XASPHERE":
        lines += [f'  XDAT {k} {decimal(v)} 0 0 1 0 0 ""' for k, v in enumerate((float(len(alpha)), 1.0, *alpha), 1)]
    lines.append(f"  DISZ {decimal(float(lens.thickness[index]))}")
    if lens.media[index] != AIR:
        lines.append(f"  GLAS {_glass(lens.media[index], names)}")
    lines.append(f"  CONI {decimal(float(lens.conic[index]))}")
    if math.isfinite(radius):
        lines += [f'  DIAM {decimal(radius)} 1 0 0 1 ""', f"  FLAP 0 {decimal(radius)} 0"]
    else:
        lines.append('  DIAM 0 0 0 0 1 ""')
    return lines


def _glass(material: Material, names: Mapping[Material, str]) -> str:
    if material.formula == "model":
        numbers = " ".join(decimal(value) for value in material.coefficients)
        label = material.name.split()[0] if " " in material.name else BLANK
        return f"{label} 1 0 {numbers} 0 0 0 0 0"
    nd, vd = map(decimal, material.abbe())  # for programs without the catalogue, from which Zemax takes the index
    return f"{names[material]} 0 0 {nd} {vd} 0 0 0 0 0 0"
