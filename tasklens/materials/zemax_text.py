"""Lines of Zemax's text files, lens files (.zmx) and glass catalogues (.AGF), in any of their encodings."""

import codecs
import math
import re
from dataclasses import dataclass
from pathlib import Path

from tasklens.runtime.files import FileError, number, read_bytes

BLANK = "___BLANK"  # Zemax's name for a glass without a name
_MARKS = {  # byte order marks; that of UTF-32 begins with that of UTF-16
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_NEWLINE = re.compile(r"\r\n|\r|\n")
_CONTROL = re.compile(r"[\0-\x08\x0e-\x1f\x7f]")


@dataclass(frozen=True)
class Line:
    """A line: a keyword and its values.

    Attributes:
        where: file and line number, for error messages.
        keyword: the first word.
        text: the rest, without surrounding spaces.
        indented: whether the line begins with a space; in a lens file it then belongs to a surface.
    """

    where: str
    keyword: str
    text: str
    indented: bool

    @property
    def words(self) -> list[str]:
        """The words after the keyword."""
        return self.text.split()

    def error(self, message: str) -> FileError:
        """Return an error that names this line and its keyword."""
        return FileError(f"{self.where}: {self.keyword}: {message}")

    def number(self, index: int, unit: float = 1.0) -> float:
        """Return word `index` after the keyword times `unit`, a finite number; raises FileError."""
        if index >= len(self.words):
            raise self.error(f"expected at least {index + 1} values, found {self.text!r}")
        value = unit * number(self.words[index], f"{self.where}: {self.keyword}")
        if math.isinf(value):
            raise self.error(f"{self.words[index]} is too large in units of {unit:g} mm")
        return value

    def integer(self, index: int) -> int:
        """Return word `index` after the keyword as an integer; raises FileError."""
        value = self.number(index)
        if value != int(value):
            raise self.error(f"expected an integer, found {self.words[index]!r}")
        return int(value)


def read_lines(path: Path) -> list[Line]:
    """Read the lines of a file that are not empty.

    Zemax writes UTF-16 with a byte order mark or ASCII; other programs write UTF-8 or UTF-16 without a mark; old files
    have an 8-bit code page.

    Raises:
        FileError: the file is not text, or has damaged characters; the message names the line.
    """
    text = _decode(read_bytes(path), path)
    if control := _CONTROL.search(text):
        row = _row(text[: control.start()])
        raise FileError(
            f"{path}, line {row}: found the control character {control[0]!r}; expected a text file in ASCII, UTF-8 or "
            "UTF-16"
        )
    lines = []
    for row, line in enumerate(_NEWLINE.split(text), 1):
        words = line.split(maxsplit=1)
        if words:
            lines.append(Line(f"{path}, line {row}", words[0], "".join(words[1:]).strip(), line[0].isspace()))
    return lines


def _decode(content: bytes, path: Path) -> str:
    """Decode by the byte order mark, by zero bytes of UTF-16 without one, as UTF-8, or else as an 8-bit code page."""
    encoding = next((name for mark, name in _MARKS.items() if content.startswith(mark)), None)
    if encoding is None and 0 in content[:2] and any(content[:2]):  # the first character is ASCII
        encoding = "utf-16-le" if content[1] == 0 else "utf-16-be"
    try:
        return content.decode(encoding or "utf-8")
    except UnicodeDecodeError as error:
        if encoding is None:
            return content.decode("latin-1")
        row = _row(content[: error.start].decode(encoding, "ignore"))
        kind = encoding.upper().removesuffix("-SIG")
        raise FileError(
            f"{path}, line {row}: not valid {kind} ({error.reason}); is the file cut off? Save it again as ASCII, "
            "UTF-8 or UTF-16"
        ) from None


def _row(before: str) -> int:
    """Return the number of the line that follows the text `before`."""
    return len(_NEWLINE.split(before))


def decimal(value: float) -> str:
    """Format a number with 17 significant digits, which restore a float64 exactly."""
    return f"{value:.17g}"
