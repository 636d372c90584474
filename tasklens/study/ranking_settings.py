"""Facts of the ranking of a study; no torch here."""

from pydantic import Field

from tasklens.settings.frozen import Frozen


class RankingSettings(Frozen):
    """Facts of the lenses of a study that `tasklens rank` adds to their files."""

    titles: dict[str, str] = Field({}, description="Display names of lenses, by lens.")
    left_out: dict[str, str] = Field({}, description="Lenses that are not measured, with the reason.")
    mtf: dict[str, float] = Field({}, description="Mean MTF of lenses, by which the sieve chose them.")
    built: tuple[str, ...] = Field((), description="Lenses to build in simulation.")
