"""Reading and writing of study files (YAML), and studies derived from one: points of a sweep, interim parts."""

from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any, get_args, get_origin

import yaml
from pydantic import ValidationError

from tasklens.runtime import yaml_files
from tasklens.runtime.files import FileError
from tasklens.settings.base import Name
from tasklens.settings.design_methods import with_named_designs
from tasklens.settings.layers import check_plain, merged_settings
from tasklens.settings.messages import missing_keys, problems, suggestion
from tasklens.study import consistency
from tasklens.study.study import Study, StudyError
from tasklens.study.sweep import points

SHIPPED = Path(__file__).parents[2] / "config"  # the studies that come with the program
_SEPARATOR = "/elements="  # between the name of a study and that of its part
EXTENDS = "Name of the study whose keys this one changes; null removes an entry of a section."


def parse(config: Mapping, files: Sequence[Path] = ()) -> Study:
    """Validate a mapping and return the study.

    Args:
        files: files that the mapping was read from, for messages and to find the study that it extends. In a study that
            extends another, a null element, design, classifier, imported lens or ablation is removed.

    Raises:
        StudyError: names every wrong key, its value and what was expected; or says that the only file extends no study.
    """
    name = f"{', '.join(map(str, files))}: " if files else ""
    if len(files) > 1 or "extends" in config:
        config = without_null(with_base_study(config, files[-1].parent if files else Path()))
    config = with_named_designs(config)
    try:
        study = Study.model_validate(config)
        consistency.check(study)
        check_plain(config, "")
        return study
    except ValidationError as error:
        missing = missing_keys(error)
        if len(files) == 1 and "format" in missing and len(missing) > 1:
            raise StudyError(
                f"{files[0]}: has no {', '.join(missing)}; name the study that it changes, such as `extends: small`"
            ) from None
        lines = problems(error, Study)
    except ValueError as error:
        lines = [str(error)]
    if len(lines) == 1:
        raise StudyError(f"{name}{lines[0]}")
    raise StudyError(f"{name}the study cannot be run:\n" + "\n".join(f"  {line}" for line in lines))


def without_null(config: Mapping) -> dict[str, Any]:
    """Remove null entries from the sections that hold entries by name."""
    sections = {
        key
        for key, field in Study.model_fields.items()
        if get_origin(field.annotation) is dict and get_args(field.annotation)[0] == Name
    }
    return {
        key: {name: entry for name, entry in value.items() if entry is not None}
        if key in sections and isinstance(value, Mapping)
        else value
        for key, value in config.items()
    }


def with_base_study(config: Mapping, folder: Path) -> dict[str, Any]:
    """Lay the keys of a study over those of the study that it extends, which may extend another one.

    Args:
        folder: folder of the file of the study.

    Raises:
        StudyError: the study has no name of its own; there is no such study to extend, or it extends itself.
    """
    if "extends" in config and "name" not in config:
        raise StudyError("name: missing; a study that extends another one needs a name of its own")
    below = [dict(config)]
    names: list[str] = []
    while (name := below[-1].pop("extends", None)) is not None:
        if not isinstance(name, str):
            raise StudyError(f"extends = {name!r}: expected the name of a study")
        if name in names:
            chain = " extends ".join([*names, name])
            raise StudyError(f"extends: {chain}; expected a study that does not extend itself")
        names.append(name)
        path = file_of(name, folder)
        below.append(dict(read(path)))
        folder = path.parent
    return reduce(merged_settings, reversed(below))


def configfile(name: str | None) -> Path:
    """Return the file of a study by its name; without a name the default study, in the folder `config` or ours.

    Raises:
        StudyError: there is no such study.
    """
    if name is not None:
        return file_of(name)
    return next(path for folder in (Path("config"), SHIPPED) if (path := folder / "config.yaml").is_file())


def file_of(name: str, *folders: Path) -> Path:
    """Return the file of a study: NAME.yaml, or a config.yaml with this name, in `folders`, `config` or `SHIPPED`.

    Raises:
        StudyError: there is no such study; the message has the nearest name, or all.
    """
    places = dict.fromkeys((*folders, Path("config"), SHIPPED))
    for folder in places:
        if (path := folder / f"{name}.yaml").is_file():
            return path
        if (path := folder / "config.yaml").is_file() and read(path).get("name") == name:
            return path
    paths = [path for folder in places for path in folder.glob("*.yaml")]
    names = sorted({str(read(path).get("name")) if path.stem == "config" else path.stem for path in paths})
    hint = suggestion(name, dict.fromkeys(names))
    raise StudyError(f"{name}.yaml: no such study in {' or '.join(map(str, places))}{hint}")


def read(path: str | Path) -> Mapping:
    """Read the keys of a study file; raises StudyError if it is not a valid YAML mapping, or is a template."""
    try:
        content = yaml_files.read(Path(path))
    except FileError as error:
        raise StudyError(str(error)) from None
    if not isinstance(content, Mapping):
        kind = "nothing" if content is None else type(content).__name__
        raise StudyError(f"{path}: expected keys and values, found {kind}")
    if "__use_yte__" in content:
        raise StudyError(
            f"{path}: __use_yte__: makes the file a template, whose code Snakemake runs before TaskLens reads it; "
            "remove this key"
        )
    return with_named_designs(content)


def load(*paths: str | Path) -> Study:
    """Read a study from YAML files, each laid over the ones before it; raises StudyError as `read` and `parse` do."""
    return parse(reduce(merged_settings, map(read, paths)), [Path(path) for path in paths])


def at_points(study: Study) -> list[Study]:
    """Return the study at every point of its sweep, named `{study}/{point}`; the study itself if it has none.

    Raises:
        InputError: names the point, and a key or a value that the study cannot have.
    """
    if not study.sweep:
        return [study]
    for key in study.sweep:
        if key.startswith("capture.sensor") and "capture.colour" not in study.sweep:
            study.capture.check_new_sensor({"sensor": key}, f"sweep.{key}")
    common = resolve(study) | {"sweep": {}}
    studies = []
    for name, point in points(study.sweep).items():
        content = common | {"name": f"{study.name}/{name}"}
        for key, value in point.items():
            nested = reduce(lambda inner, part: {part: inner}, reversed(key.split(".")), value)
            content = merged_settings(content, nested)
        try:
            studies.append(parse(content))
        except StudyError as error:
            raise StudyError(f"sweep, {name}: {error}") from None
    return studies


def resolve(study: Study) -> dict[str, Any]:
    """Return a study with all defaults, as keys and values of a file."""
    return yaml.safe_load(dump(study))


def dump(study: Study) -> str:
    """Return the resolved study as YAML, with all defaults."""
    return yaml.safe_dump(study.model_dump(mode="json", exclude_computed_fields=True), sort_keys=False)


def parts(study: Study) -> list[Study]:
    """Return the parts of a study, named `{study}/elements={first}+...`, which use its lenses and networks.

    They are its interim reports, table 1 and a page: each has one element count more than the one before it, and the
    last has one fewer than the study. A sweep, or a study without table 1, has none.
    """
    if study.sweep or "table1" not in study.tables:
        return []
    names = list(study.elements)
    return [_part(study, names[:count]) for count in range(1, len(names))]


def whole_study_name(name: str) -> str:
    """Return the name of the study whose lenses and networks a study uses: its own, unless it is a part."""
    return name.partition(_SEPARATOR)[0]


def _part(study: Study, names: list[str]) -> Study:
    content = resolve(study)
    content |= {
        "name": f"{study.name}{_SEPARATOR}{'+'.join(names)}",
        "tables": ["table1"],
        "elements": {name: content["elements"][name] for name in names},
        "specs": {name: spec for name, spec in content["specs"].items() if name in names},
        "imported": {name: lens for name, lens in content["imported"].items() if lens["elements"] in names},
        "ablations": {},
        "restored": None,
        "tasks": content["tasks"] | {"designs": None},
        "tolerances": content["tolerances"] | {"designs": None},
    }
    return parse(content)
