"""Text representation of results in a few lines."""

from __future__ import annotations

import textwrap
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

Shown = TypeVar("Shown", bound=type)

_MOST_ROWS = 9
_MOST_LETTERS = 72


def shown(cls: Shown) -> Shown:
    """Make a dataclass show its fields in at most ten lines.

    Arrays and poses are told by type and shape. A class may say what to show in a method `facts`, which
    returns names and values.
    """
    cls.__repr__ = _text  # type: ignore[assignment]
    return cls


def brief(value: Any) -> str:
    """One short line for a value."""
    if hasattr(value, "dtype") and np.prod(value.shape) > 6:
        text = f"{value.dtype} {value.shape}"
    elif isinstance(value, Rotation | RigidTransform):
        text = type(value).__name__ + ("" if value.single else f" ({len(value)},)")
    elif is_dataclass(value):
        text = f"{type(value).__name__}: " + ", ".join(
            f"{k} {brief(part)}" for k, part in vars(value).items()
        )
    elif isinstance(value, dict | tuple):
        text = ", ".join(map(brief, value)) if len(value) <= 4 else f"{len(value)}"
    else:
        text = (
            f"{value:.4g}" if isinstance(value, float) else "none" if value is None else str(value) or "none"
        )
    return textwrap.shorten(text, _MOST_LETTERS, placeholder="…")


def _text(self: Any) -> str:
    if hasattr(self, "facts"):
        rows = self.facts()
    else:
        rows = [(field.name, getattr(self, field.name)) for field in fields(self) if field.repr]
    if len(rows) > _MOST_ROWS:
        rest = ", ".join(name for name, _ in rows[_MOST_ROWS - 1 :])
        rows = [*rows[: _MOST_ROWS - 1], ("and", rest)]
    width = max(len(name) for name, _ in rows)
    return "\n".join([type(self).__name__, *(f"  {name:<{width}}  {brief(value)}" for name, value in rows)])
