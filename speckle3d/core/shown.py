"""How results show themselves: a few lines of text, or a small table in a notebook."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import fields, is_dataclass
from html import escape
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

Shown = TypeVar("Shown", bound=type)

_MOST_ROWS = 9
_MOST_LETTERS = 72


def shown(cls: Shown) -> Shown:
    """Make a dataclass show its fields in at most ten lines, and as a table in a notebook.

    Arrays are told by type and shape, poses by their number. A class may say what to show in a method
    `facts`, which returns names and values.
    """
    cls.__repr__ = _text  # type: ignore[assignment]
    cls._repr_html_ = _table  # type: ignore[attr-defined]
    return cls


def brief(value: Any) -> str:
    """One short line for a value."""
    if isinstance(value, np.ndarray):
        text = f"{value.dtype} {value.shape}" if value.size > 6 else np.array2string(value, precision=4)
    elif isinstance(value, Rotation | RigidTransform):
        text = _turn(value) if value.single else f"{len(value)} {_KINDS[type(value)]}s"
    elif isinstance(value, float):
        text = f"{value:.4g}"
    elif isinstance(value, Collection) and not isinstance(value, str):
        text = ", ".join(map(brief, value)) if len(value) <= 4 else f"{len(value)}"
    else:
        text = type(value).__name__ if is_dataclass(value) else "" if value is None else str(value)
    text = " ".join(text.split()) or "none"
    return text if len(text) <= _MOST_LETTERS else f"{text[: _MOST_LETTERS - 1]}…"


_KINDS = {Rotation: "rotation", RigidTransform: "rigid transform"}


def _turn(pose: Rotation | RigidTransform) -> str:
    rotation = pose.rotation if isinstance(pose, RigidTransform) else pose
    text = f"rotation by {np.rad2deg(rotation.magnitude()):.4g} degrees"
    place = f", translation {np.round(pose.translation, 3)} mm" if isinstance(pose, RigidTransform) else ""
    return text + place


def _rows(thing: Any) -> list[tuple[str, str]]:
    held = [(each.name, getattr(thing, each.name)) for each in fields(thing) if each.repr]
    rows = [(name, brief(value)) for name, value in (thing.facts() if hasattr(thing, "facts") else held)]
    if len(rows) <= _MOST_ROWS:
        return rows
    rest = ", ".join(name for name, _ in rows[_MOST_ROWS - 1 :])
    return [*rows[: _MOST_ROWS - 1], ("and", brief(rest))]


def _text(self: Any) -> str:
    rows = _rows(self)
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join([type(self).__name__, *(f"  {name:<{width}}  {value}" for name, value in rows)])


def _table(self: Any) -> str:
    cell = "<t{0} style='text-align:left'>{1}</t{0}>"
    rows = (cell.format("h", escape(name)) + cell.format("d", escape(value)) for name, value in _rows(self))
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return f"<table><caption>{escape(type(self).__name__)}</caption>{body}</table>"
