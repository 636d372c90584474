"""What a person reads after a mistake in a study file: one sentence in words of the file, none of pydantic's."""

import re

import pytest
import yaml
from examples import changed, tiny_study

from tasklens.cli.app import main
from tasklens.study.loading import parse
from tasklens.study.study import Study, StudyError

INNER_WORDS = re.compile(
    r"Input should|Field required|Extra inputs|Value error|\b(union|tagged|discriminator|pydantic|tuple|dict|validation"
    r"|NoneType|mapping)\b|Settings\b|function-|should be strings",
    re.IGNORECASE,
)
METHODS = "end_to_end, image_quality, joint_ray_space, least_squares, spot, task"

# key, its value (or what is removed), the sentence
REMOVED = object()
MISTAKES = [
    ("seed", 3, "seed = 3: unknown key; did you mean seeds?"),
    ("kernel_size", 51, "kernel_size = 51: unknown key; did you mean spec.kernel_size?"),
    ("designs.mine", {"steps": 3}, f"designs.mine.method: missing; one of {METHODS}"),
    ("designs.imaging1.method", "spott", "designs.imaging1.method = 'spott': unknown; did you mean spot?"),
    ("designs.mine", None, "designs.mine = null: expected keys and values"),
    ("designs.imaging1.steps", "many", "designs.imaging1.steps = 'many': expected a whole number"),
    ("designs.tasklens.restart.pixels", [5], "designs.tasklens.restart.pixels: entry 2 is missing"),
    ("images", REMOVED, "images: missing: The labelled images."),
    ("images.sise", 32, "images.sise = 32: unknown key; did you mean size?"),
    ("name", "My Study", "name = 'My Study': expected a name of lower-case letters, digits and _"),
    ("format", 3, "format = 3: expected 2"),
    ("seeds", 3, "seeds = 3: expected a list"),
    ("seeds", [1.5], "seeds.0 = 1.5: expected a whole number"),
    ("elements.singlet", "COC", "elements.singlet = 'COC': expected a list"),
    ("elements.singlet", [], "elements.singlet: expected at least one plastic"),
    (
        "elements.singlet",
        ["CO"],
        "elements.singlet: unknown plastic 'CO'; known ones nearest to it: COC, PC, OKP4, OKP4HT, PS, PMMA",
    ),
    ("spec.f_number", -2, "spec.f_number = -2: expected greater than 0"),
    ("spec.kernel_size", 50, "spec.kernel_size = 50: expected an odd number, so that the PSF has a central pixel"),
    (
        "spec.wavelengths_um",
        [0.6, 0.55, 0.5, 0.45],
        "spec.wavelengths_um = [0.6, 0.55, 0.5, 0.45]: expected at most 3, found 4",
    ),
    ("supervisor", "smal", "supervisor: 'smal' is not one of small, other"),
    ("tables", ["table9"], "tables.0 = 'table9': expected 'table1', 'table2', 'table3' or 'table4'"),
    ("capture.colour", "rgb", "capture.colour = 'rgb': expected 'srgb' or 'linear'"),
    ("classifiers.small.pretrained", "maybe", "classifiers.small.pretrained = 'maybe': expected true or false"),
]


def wrong(key: str, value: object) -> dict:
    study = tiny_study()
    if value is not REMOVED:
        return changed(study, key, value)
    del study[key]
    return study


@pytest.mark.parametrize("key, value, sentence", MISTAKES, ids=[f"{k}-{n}" for n, (k, _, _) in enumerate(MISTAKES)])
def test_a_typical_mistake_has_one_sentence(key, value, sentence):
    with pytest.raises(StudyError) as error:
        parse(wrong(key, value))
    assert str(error.value) == sentence


def test_the_file_and_all_its_mistakes_are_named(tmp_path, capsys):
    """On standard error, with exit status 2."""
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(wrong("seed", 3)))
    assert main(["study", "check", str(path)]) == 2
    assert capsys.readouterr().err == f"tasklens: {path}: seed = 3: unknown key; did you mean seeds?\n"
    path.write_text(yaml.safe_dump(changed(wrong("seed", 3), "spec.f_number", "fast")))
    assert main(["study", "check", str(path)]) == 2
    first, *lines = capsys.readouterr().err.splitlines()
    assert first == f"tasklens: {path}: the study cannot be run:"
    assert lines == ["  spec.f_number = 'fast': expected a number", "  seed = 3: unknown key; did you mean seeds?"]
    path.write_text("seeds: [0\nname: x\n")
    assert main(["study", "check", str(path)]) == 2
    assert capsys.readouterr().err.startswith(f"tasklens: {path}, line 2: not valid YAML: ")


def keys(study: object, at: str = "") -> list[str]:
    """All keys of a study at any depth."""
    found = [f"{at}{key}" for key in study] if isinstance(study, dict) else []
    return found + [inner for key in found for inner in keys(study[key.removeprefix(at)], f"{key}.")]


@pytest.mark.parametrize("value", [None, True, -1, 1.5, "word", [], ["word"], {}, {"word": 1}, {3: 4}, [[1, 2], 3]])
def test_no_inner_word_reaches_the_user(value):
    """Whatever stands at whatever key of a study; most of it is refused."""
    refused = 0
    for key in sorted({*Study.model_fields, *keys(tiny_study())}):
        try:
            parse(changed(tiny_study(), key, value))
        except StudyError as error:
            refused += 1
            assert not INNER_WORDS.search(str(error)), (key, str(error))
    assert refused > 20
