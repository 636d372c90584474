"""Keywords of Zemax lens files: supported, without effect on rays, or required to have a neutral value.

Any other keyword of the system or of a surface is an error, so that no data that may change rays are ignored.
"""

from tasklens.materials.zemax_text import Line


def keywords(text: str) -> frozenset[str]:
    """Return the words of a text."""
    return frozenset(text.split())


SYSTEM = keywords(
    "MODE NAME UNIT ENPD FNUM FLOA OBNA ENVD GFAC GCAT FTYP XFLN YFLN XFLD YFLD FEFD WAVM WAVL WAVN PWAV MNUM "
    "VDXN VDYN VCXN VCYN WWGN WWGT"
)
SURFACE = keywords("STOP COMM TYPE CURV PARM XDAT DISZ GLAS CONI DIAM CLAP FLAP")

# Weights of fields, copies of FEFD, ray aiming, polarisation, bookmarks, names of files, settings of analyses and
# displays.
_HARMLESS_SYSTEM = keywords(
    "! AUTH BKMK BLNK BMRK BOOK CHZH COFN DBDT EERA FCOM FENF FSVY FWGN FWGT GLRS GSTD HYPR IWDP LANG LUID MOFF NOTE "
    "NSCD OMMA PFIL PICB "
    "POLS PUSH RAIM ROPD SDMA STUD TOL VANN VERS XAIM YAIM ZAIM ZVAN ZVCX ZVCY ZVDX ZVDY"
)
# Solves and variables (the file has their values), coatings, colours, drawing, mechanical radii, tolerances.
SOLVES = keywords("CHZH EDGE MAZH PPAR PZUP")
_HARMLESS_SURFACE = SOLVES | keywords(
    "! BKMK BMRK BOOK COAT FIMP FSVY MEMA MIRR OEMA POPS SCOL SLAB SSID STUD TCED TCMM TOLE VCON VDSZ VPAR"
)
_APERTURES = keywords("SQAP SQOB ELAP ELOB UDAD UDAO USAP OBSC SPID")  # neither round nor clear

_CLIMATE = "only indices at 20 deg C and 1 atm are supported"
_IGNORED = "ignored surfaces are not supported; delete this one in Zemax, or do not ignore it"
_DECENTRED = "decentred apertures are not supported; centre it, or delete it and its CLAP or FLAP"
_TILTED = "tilted and decentred surfaces are not supported; expected a lens symmetric about its axis"
_TELECENTRIC = "a telecentric object space is not supported; switch it off in Zemax"
_AFOCAL = "an afocal image space is not supported; switch it off in Zemax"
_HIDDEN = "only the first four flags are known to affect only drawings; set the others to 0"

# Words by position, with the only supported value; a missing word is neutral.
_NEUTRAL: dict[str, dict[int, tuple[float, str]]] = {
    "FTYP": {1: (0, _TELECENTRIC), 6: (0, _AFOCAL)},
    "ENVD": {0: (20, _CLIMATE), 1: (1, _CLIMATE)},  # here the adjustment (third word) has no effect
    "OBDC": {0: (0, _DECENTRED), 1: (0, _DECENTRED)},
    "IGNR": {0: (0, _IGNORED)},
    "HIDE": {i: (0, _HIDDEN) for i in range(4, 16)},
}
# Data of a configuration, after the surfaces: KEYWORD surface configuration value.
_CONFIGURATION: dict[str, tuple[float, str]] = {
    "IGNR": (0, _IGNORED),
    "IGNM": (0, _IGNORED),
    "TELE": (0, _TELECENTRIC),
    "AFOC": (0, _AFOCAL),
    "TEMP": (20, _CLIMATE),
    "PRES": (1, _CLIMATE),
    **{key: (0, _TILTED) for key in keywords("CADX CADY CATX CATY CATZ CBDX CBDY CBTX CBTY CBTZ CROR")},
}


def check_system(line: Line) -> None:
    """Check a line before the surfaces; raises FileError unless it is supported, neutral or harmless."""
    if line.keyword in _CONFIGURATION:
        check_configuration(line)
    elif line.keyword not in SYSTEM | _HARMLESS_SYSTEM:
        raise _unknown_keyword(line)
    _check_neutral(line)
    if line.keyword == "GFAC" and not _uniform(line):
        raise line.error(f"apodised pupils are not supported; switch the apodisation off in Zemax; found {line.text!r}")


def _uniform(line: Line) -> bool:
    """Return whether an apodisation is uniform: type 0, or type 1 (Gaussian) with factor 0."""
    return line.number(0) == 0 or (line.number(0) == 1 and len(line.words) > 1 and line.number(1) == 0)


def check_surface(line: Line) -> None:
    """Check a line of a surface; raises FileError unless it is supported, neutral or harmless."""
    if line.keyword == "SCBD":
        raise line.error(_TILTED)
    if line.keyword.startswith("NS") or (line.keyword == "TYPE" and line.words[:1] == ["NONSEQCO"]):
        raise line.error("non-sequential components are not supported; expected a file of sequential surfaces only")
    if line.keyword not in SURFACE | _HARMLESS_SURFACE | _APERTURES | {"OBDC", "IGNR", "HIDE"}:
        raise _unknown_keyword(line)
    if line.keyword in ("IGNR", "HIDE"):
        _check_neutral(line)


def check_configuration(line: Line) -> None:
    """Check a line of the active configuration; raises FileError."""
    if line.keyword in _CONFIGURATION:
        neutral, message = _CONFIGURATION[line.keyword]
        if line.number(max(0, min(2, len(line.words) - 1))) != neutral:
            raise line.error(f"{message}; found {line.text!r}")


def check_trailer(line: Line) -> None:
    """Check that a line after the surfaces does not belong to one; raises FileError."""
    if line.keyword in SURFACE | _APERTURES | {"OBDC", "SCBD", "HIDE"}:
        raise line.error("belongs to a surface: indent it below its line SURF")


def check_aperture(line: Line) -> None:
    """Check that an aperture of a surface that rays pass is a centred circle; raises FileError."""
    if line.keyword in _APERTURES:
        raise line.error("only round clear apertures (CLAP, FLAP) are supported")
    if line.keyword == "OBDC":
        _check_neutral(line)


def _check_neutral(line: Line) -> None:
    for index, (neutral, message) in _NEUTRAL.get(line.keyword, {}).items():
        if index < len(line.words) and line.number(index) != neutral:
            raise line.error(f"{message}; found {line.text!r}")


def _unknown_keyword(line: Line) -> Exception:
    return line.error(f"unknown keyword (with {line.text!r}), which may change rays; delete the line if it does not")
