"""TOML files checked against a pydantic model, so that an error names the file and the setting."""

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.io.hdf5 import reading

Model = TypeVar("Model", bound=BaseModel)


def load_toml(model: type[Model], path: Path) -> Model:
    """Read settings of a model from a TOML file; those that it does not give keep their defaults.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        Naming the setting that is unknown or out of range.
    """
    return validated(parsed(read_toml(path), str(path)), str(path), model)


def read_toml(path: Path) -> str:
    """Read the text of a TOML file.

    Raises
    ------
    FileError
        If the file cannot be read, or is no UTF-8.
    """
    with reading(path), open_regular(path) as stream:
        return stream.read().decode("utf-8-sig")


def parsed(text: str, where: str) -> dict[str, Any]:
    """Parse TOML text; `where` is named in errors."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(f"{where}: expected TOML, got an error: {error}") from error


def first_fault(error: ValidationError) -> tuple[str, str]:
    """Return the name of the first setting that is wrong, and what is wrong with it."""
    first = error.errors()[0]
    fault = f"{first['msg'].removeprefix('Value error, ')}, got {first['input']!r:.200}"
    return ".".join(map(str, first["loc"])), fault


def validated(values: dict[str, Any], where: str, model: type[Model]) -> Model:
    """Make a model of values; an error names `where` and the first wrong setting."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        name, fault = first_fault(error)
        raise InvalidInputError(f"{where}: {f'{name}: ' if name else ''}{fault}") from error
