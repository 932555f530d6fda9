"""Wrong kinds of arguments, told in a line instead of failing deep inside."""

from __future__ import annotations

from typing import Any

from speckle3d.core.errors import InvalidInputError


def require_kind(value: Any, kind: type, name: str, made_by: str) -> None:
    """Raise unless an argument is of a kind.

    Parameters
    ----------
    value : object
        The argument.
    kind : type
    name : str
        Of the argument.
    made_by : str
        What makes such an object, as ``load_sweep(path)``.

    Raises
    ------
    InvalidInputError
        If it is something else.
    """
    if not isinstance(value, kind):
        got = type(value).__name__
        raise InvalidInputError(f"{name}: expected a {kind.__name__}, as {made_by} gives it, got {got}")
