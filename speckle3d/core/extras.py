"""Packages that only some tasks need, installed as extras."""

import importlib
from importlib.util import find_spec
from typing import Any

from speckle3d.core.errors import InvalidInputError


def require_extra(extra: str, what: str, *packages: str) -> None:
    """Refuse a task whose packages are not installed, naming the extra that brings them.

    Parameters
    ----------
    extra : str
        Of this distribution.
    what : str
        The task, to begin the sentence with.
    packages : str
        As they are imported.

    Raises
    ------
    InvalidInputError
        If one is missing.
    """
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise InvalidInputError(f'{what} needs {", ".join(missing)}: pip install "speckle3d[{extra}]"')


def extra_module(name: str, extra: str, what: str) -> Any:
    """Import a module of a package that only some tasks need; see `require_extra`."""
    require_extra(extra, what, name.split(".")[0])
    return importlib.import_module(name)
