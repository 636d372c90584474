"""Names of the glasses of a lens in a Zemax file, each of which means the same glass when the file is read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

from tasklens.materials.library import in_zemax, is_maker, of_maker
from tasklens.materials.material import AIR, Material


@dataclass(frozen=True)
class NamedGlasses:
    """Glasses of a lens by the names that they have in a Zemax file.

    Attributes:
        names: name of every glass that is in a catalogue; air and model glasses are in none.
        catalogues: the catalogues to search, in this order (GCAT).
        own: glasses, by their names, for a catalogue of the lens itself.
    """

    names: Mapping[Material, str]
    catalogues: Sequence[str]
    own: Sequence[Material]

    @classmethod
    def of(cls, media: Sequence[Material], catalogue: str) -> "NamedGlasses":
        """Name the glasses of a lens.

        A glass has its name in OpticStudio. It goes into the lens' own `catalogue`, which is searched first, if
        OpticStudio does not have it, or if a catalogue that is searched before its own may have another of this name.
        """
        glasses = [glass for glass in dict.fromkeys(media) if glass != AIR and glass.formula != "model"]
        used = dict.fromkeys(glass.zemax.split()[0] for glass in glasses if glass.zemax)
        catalogues = min(permutations(used), key=lambda order: sum(_hidden(glass, order) for glass in glasses))
        names: dict[Material, str] = {}
        own: list[Material] = []
        for glass in glasses:
            name = glass.zemax.split()[-1] if glass.zemax else glass.name
            if name in names.values():
                name = f"{name}_{len(own) + 2}"
                own.append(replace(glass, name=name))
            elif not glass.zemax or _hidden(glass, catalogues):
                own.append(replace(glass, name=name))
            names[glass] = name
        needed = {
            glass.zemax.split()[0] for glass in glasses if glass.zemax and names[glass] not in {g.name for g in own}
        }
        listed = [name for name in catalogues if name in needed]
        return cls(names, [*([catalogue.upper()] if own else []), *listed], own)


def _hidden(glass: Material, catalogues: Sequence[str]) -> bool:
    """Return whether a catalogue in front of a glass' own may have another glass of its name."""
    if not glass.zemax:
        return False
    own, name = glass.zemax.split()
    for catalogue in catalogues[: catalogues.index(own)]:
        contents = _contents(catalogue)
        if contents is None or (name in contents and contents[name].coefficients != glass.coefficients):
            return True
    return False


def _contents(catalogue: str) -> Mapping[str, Material] | None:
    """Return the glasses that OpticStudio has in a catalogue; None if that is not known."""
    name = catalogue.upper()
    if is_maker(name):
        return of_maker(name)
    return in_zemax(name) or None
