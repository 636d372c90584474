"""Messages about mistakes in a study file: one sentence in the words of the file, not in those of pydantic."""

import pytest
import yaml
from examples import changed, tiny_study
from inner_words import INNER_WORDS

from tasklens.cli.app import main
from tasklens.study.loading import parse
from tasklens.study.study import Study, StudyError


def test_the_file_and_all_its_mistakes_are_named(tmp_path, capsys):
    """On standard error, with exit status 2."""
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(changed(tiny_study(), "seed", 3)))
    assert main(["study", "check", str(path)]) == 2
    assert capsys.readouterr().err == f"tasklens: {path}: seed = 3: unknown key; did you mean seeds?\n"
    path.write_text(yaml.safe_dump(changed(changed(tiny_study(), "seed", 3), "spec.f_number", "fast")))
    assert main(["study", "check", str(path)]) == 2
    first, *lines = capsys.readouterr().err.splitlines()
    assert first == f"tasklens: {path}: the study cannot be run:"
    assert lines == ["  spec.f_number = 'fast': expected a number", "  seed = 3: unknown key; did you mean seeds?"]


def keys(study: object, at: str = "") -> list[str]:
    """All keys of a study at any depth, and indices of list entries."""
    inner = study.items() if isinstance(study, dict) else enumerate(study) if isinstance(study, list) else ()
    return [key for name, value in inner for key in (f"{at}{name}", *keys(value, f"{at}{name}."))]


@pytest.mark.parametrize("value", [None, -1, "word", ["word"], {"word": 1}, {3: 4}])
def test_no_inner_word_reaches_the_user(value):
    """Any value at any key of a study; most combinations are refused."""
    refused = 0
    for key in sorted({*Study.model_fields, *keys(tiny_study())}):
        try:
            parse(changed(tiny_study(), key, value))
        except StudyError as error:
            refused += 1
            assert not INNER_WORDS.search(str(error)), (key, str(error))
    assert refused > 20
