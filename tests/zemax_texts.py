"""A lens file and a glass catalogue in the formats of Zemax, and readers of their text."""

from tasklens.optics.io import zemax

LENS_TEXT = """VERS 190513 80 123457 L123457
MODE SEQ
NAME A doublet
UNIT MM X W X CM MR CPMM
ENPD 1.2
GCAT SECOND FIRST
FTYP 0 0 2 3 0 0 0 2
XFLN 0 1.5
YFLN 0 20
WAVM 1 0.6563 1
WAVM 2 0.5893 1
WAVM 3 0.4861 1
WAVM 4 0.55 1
PWAV 2
SURF 0
  TYPE STANDARD
  CURV 0
  DISZ INFINITY
SURF 1
  COMM front  lens
  TYPE EVENASPH
  CURV 0.25 0 0 0 0 ""
  PARM 1 0.01
  PARM 2 -0.002
  PARM 8 1e-06
  DISZ 0.8
  GLAS COC 0 0 1.5 40
  CONI -0.5
  DIAM 0.9 0 0 0 1 ""
SURF 2
  TYPE STANDARD
  CURV -0.1
  DISZ 0.3
  DIAM 0.8 1 0 0 1 ""
SURF 3
  STOP
  CURV 0
  DISZ 0.2
  DIAM 0.55 0 0 0 1 ""
SURF 4
  TYPE STANDARD
  CURV 0.1
  DISZ 0.6
  GLAS ___BLANK 1 0 1.64 23.3 0.01
  FLAP 0 1.1 0
SURF 5
  TYPE STANDARD
  CURV 0
  DISZ 2.5
SURF 6
  TYPE STANDARD
  CURV 0
  DISZ 0
TOL TOFF 0
MNUM 1 1
"""

CATALOGUE_TEXT = """CC a catalogue
NM CROWN 1 517642 1.5168 64.2 0 0
GC
CD 2.29 -0.0102 0.0134 2.0E-004 0 0 0 0 0 0
TD 0
LD 0.4 0.8
NM FLINT 5 0 1.62 36
CD 1.5 0.01 0.002
LD 3.5E-001 9.0E-001
"""


def read_lens(tmp_path, text=LENS_TEXT, catalogues=(), encoding="utf-8"):
    """The lens of a text, as read from tmp_path/lens.zmx."""
    (tmp_path / "lens.zmx").write_bytes(text.encode(encoding))
    return zemax.read(tmp_path / "lens.zmx", catalogues)


def edit(*changes: tuple[str, str]) -> str:
    """The text of the lens with words replaced that occur in it once."""
    text = LENS_TEXT
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text
