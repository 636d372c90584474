"""Names of the glasses of a lens in a Zemax file: reading the file with them gives the same glasses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

from tasklens.materials.library import in_zemax, is_maker, of_maker
from tasklens.materials.material import AIR, Material


@dataclass(frozen=True)
class NamedGlasses:
    """Glasses of a lens and their names in a Zemax file.

    Attributes:
        names: name of every glass that is in a catalogue; air and model glasses have none.
        catalogues: the catalogues to search, in this order (GCAT).
        own: glasses for the catalogue of the lens itself, with their names there.
    """

    names: Mapping[Material, str]
    catalogues: Sequence[str]
    own: Sequence[Material]

    @classmethod
    def of(cls, media: Sequence[Material], catalogue: str) -> "NamedGlasses":
        """Name the glasses of a lens.

        A glass keeps its name in OpticStudio. It is added to `catalogue`, which belongs to the lens and is searched
        first, if OpticStudio does not have it, or if a catalogue that is searched earlier may have another glass of
        this name.
        """
        glasses = [glass for glass in dict.fromkeys(media) if glass != AIR and glass.formula != "model"]
        candidates = dict.fromkeys(glass.zemax.split()[0] for glass in glasses if glass.zemax)
        catalogues = min(
            permutations(candidates), key=lambda order: sum(_may_be_hidden(glass, order) for glass in glasses)
        )
        names: dict[Material, str] = {}
        own: list[Material] = []
        for glass in glasses:
            name = glass.zemax.split()[-1] if glass.zemax else glass.name
            if name in names.values():
                name = f"{name}_{len(own) + 2}"
                own.append(replace(glass, name=name))
            elif not glass.zemax or _may_be_hidden(glass, catalogues):
                own.append(replace(glass, name=name))
            names[glass] = name
        in_use = {
            glass.zemax.split()[0] for glass in glasses if glass.zemax and names[glass] not in {g.name for g in own}
        }
        search_order = [name for name in catalogues if name in in_use]
        return cls(names, [*([catalogue.upper()] if own else []), *search_order], own)


def _may_be_hidden(glass: Material, catalogues: Sequence[str]) -> bool:
    """Return whether a catalogue that is searched before the glass's own may have another glass of its name."""
    if not glass.zemax:
        return False
    own, name = glass.zemax.split()
    for catalogue in catalogues[: catalogues.index(own)]:
        contents = _contents(catalogue)
        if contents is None or (name in contents and contents[name].coefficients != glass.coefficients):
            return True
    return False


def _contents(catalogue: str) -> Mapping[str, Material] | None:
    """Return the glasses of a catalogue of OpticStudio; None if its contents are unknown."""
    name = catalogue.upper()
    if is_maker(name):
        return of_maker(name)
    return in_zemax(name) or None
