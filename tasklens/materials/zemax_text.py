"""Lines of Zemax's text files, lens files (.zmx) and glass catalogues (.AGF), in any of their encodings."""

import codecs
import re
from dataclasses import dataclass
from pathlib import Path

from tasklens.runtime.files import FileError, number


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
        """The words behind the keyword."""
        return self.text.split()

    def error(self, message: str) -> FileError:
        """Return an error that names this line and its keyword."""
        return FileError(f"{self.where}: {self.keyword}: {message}")

    def number(self, index: int) -> float:
        """Return word `index` behind the keyword as a finite number; raises FileError."""
        if index >= len(self.words):
            raise self.error(f"expected at least {index + 1} values, found {self.text!r}")
        return number(self.words[index], f"{self.where}: {self.keyword}")

    def integer(self, index: int) -> int:
        """Return word `index` behind the keyword as an integer; raises FileError."""
        value = self.number(index)
        if value != int(value):
            raise self.error(f"expected an integer, found {self.words[index]!r}")
        return int(value)


def read_lines(path: Path) -> list[Line]:
    """Read the lines of a file that are not empty.

    Zemax writes UTF-16 with a byte order mark or ASCII, other programs UTF-8, old files have an 8-bit code page.

    Raises:
        FileError: the file is no text.
    """
    content = path.read_bytes()
    try:
        if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            text = content.decode("utf-16")
        else:
            text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    if "\0" in text:
        raise FileError(f"{path}: expected a text file")
    found = []
    for row, line in enumerate(re.split(r"\r\n|\r|\n", text), 1):
        words = line.split(maxsplit=1)
        if words:
            found.append(Line(f"{path}, line {row}", words[0], "".join(words[1:]).strip(), line[0].isspace()))
    return found


def decimal(value: float) -> str:
    """Format a number with 17 significant digits, which restore a float64 exactly."""
    return f"{value:.17g}"
