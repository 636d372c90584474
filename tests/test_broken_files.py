"""A damaged file of a lens or of materials is read, or refused with a FileError that names it."""

import random

import pytest
import yaml
from prescriptions import random_prescription
from zemax_texts import CATALOGUE_TEXT, LENS_TEXT, whole_catalogue

from tasklens.materials import catalogues
from tasklens.optics.io import prescription, zemax
from tasklens.runtime.files import FileError

YAML_TEXT = yaml.safe_dump(prescription.to_dict(random_prescription(6)), sort_keys=False)
JUNK = (
    "",
    "-",
    "1e999",
    "nan",
    "INFINITY",
    "99999999999",
    "-1",
    "0",
    "x",
    "[]",
    "{}",
    "1.5.2",
    '"',
    ":",
    "\n",
    "  ",
    "true",
)


def damage(text: str, generator: random.Random) -> str:
    """The text with one to three words replaced, lines removed or repeated, or characters overwritten."""
    for _ in range(generator.randint(1, 3)):
        lines = text.split("\n")
        row = generator.randrange(len(lines))
        match generator.randrange(4):
            case 0:
                words = lines[row].split(" ")
                words[generator.randrange(len(words))] = generator.choice(JUNK)
                lines[row] = " ".join(words)
            case 1:
                del lines[row]
            case 2:
                lines.insert(row, generator.choice(lines))
            case 3:
                column = generator.randrange(len(lines[row]) + 1)
                lines[row] = lines[row][:column] + generator.choice(JUNK) + lines[row][column + 1 :]
        text = "\n".join(lines)
    return text


@pytest.mark.parametrize(
    "name, text, read",
    [
        ("lens.zmx", LENS_TEXT, zemax.read),
        ("lens.yaml", YAML_TEXT, prescription.read),
        ("maker.agf", CATALOGUE_TEXT, whole_catalogue),
        ("plastics.yaml", catalogues.PLASTICS.read_text(), catalogues.read),
    ],
)
def test_a_damaged_file_is_read_or_refused(tmp_path, name, text, read):
    generator, refused = random.Random(5), 0
    for _ in range(150):
        (tmp_path / name).write_text(damage(text, generator))
        try:
            read(tmp_path / name)
        except FileError as error:
            assert name in str(error)
            refused += 1
    assert 30 < refused < 150
