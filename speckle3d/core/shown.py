"""How results show themselves: a few lines of text, or a small table in a notebook."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import fields, is_dataclass
from html import escape
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

Shown = TypeVar("Shown", bound=type)

MOST_LINES = 10
_MOST_LETTERS = 96
_NAME_LETTERS = 60


def shown(cls: Shown) -> Shown:
    """Make a dataclass show its fields in at most ten lines, and as a table in a notebook.

    Arrays are told by type and shape, poses by their number. A class may say what to show in a method
    `facts`, which returns names and values.
    """
    cls.__repr__ = _text  # type: ignore[assignment]
    cls._repr_html_ = _table  # type: ignore[attr-defined]
    return cls


def facts_of(thing: Any) -> list[tuple[str, str]]:
    """Names and short values of what an object holds."""
    if hasattr(thing, "facts"):
        return [(name, brief(value)) for name, value in thing.facts()]
    return [(each.name, brief(getattr(thing, each.name))) for each in fields(thing) if each.repr]


def brief(value: Any) -> str:
    """One short line for a value."""
    if value is None:
        return "none"
    if isinstance(value, np.ndarray) and value.size > 6:
        return f"{value.dtype} {value.shape}"
    if isinstance(value, np.ndarray):
        return _clipped(np.array2string(value, precision=4, separator=", ").replace("\n", ""))
    if hasattr(value, "single") and hasattr(value, "as_matrix"):
        return _turns(value)
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, str | Path):
        return _clipped(str(value) or "none")
    if is_dataclass(value) and not isinstance(value, type):
        return _clipped(f"{type(value).__name__}: {', '.join(f'{n} {v}' for n, v in facts_of(value))}")
    if isinstance(value, Mapping):
        return _clipped(f"{len(value)}: {', '.join(map(str, value))}" if value else "none")
    if isinstance(value, Collection):
        whole = ", ".join(map(brief, value)) if len(value) <= _FEW else ""
        return whole if whole and len(whole) <= _NAME_LETTERS else f"{len(value)}" if value else "none"
    return _clipped(str(value))


_FEW = 4


def _turns(value: Any) -> str:
    """Rotations or rigid transforms: how many, or the one."""
    single = value.single
    what = "rotation" if not hasattr(value, "translation") else "rigid transform"
    if not single:
        return f"{len(value)} {what}s"
    turn = value.rotation if hasattr(value, "translation") else value
    angle = f"{np.rad2deg(turn.magnitude()):.4g} degrees"
    if not hasattr(value, "translation"):
        return f"rotation by {angle}"
    place = ", ".join(f"{each:.4g}" for each in value.translation)
    return f"rotation by {angle}, translation ({place}) mm"


def _clipped(text: str, letters: int = _MOST_LETTERS - 24) -> str:
    text = " ".join(text.split())
    return text if len(text) <= letters else f"{text[: letters - 1]}…"


def _rows(thing: Any) -> list[tuple[str, str]]:
    rows = facts_of(thing)
    if len(rows) < MOST_LINES:
        return rows
    left = ", ".join(name for name, _ in rows[MOST_LINES - 2 :])
    return [*rows[: MOST_LINES - 2], ("and", _clipped(left))]


def _text(self: Any) -> str:
    rows = _rows(self)
    width = max((len(name) for name, _ in rows), default=0)
    lines = [f"  {name:<{width}}  {value}"[:_MOST_LETTERS].rstrip() for name, value in rows]
    return "\n".join([type(self).__name__, *lines])


def _table(self: Any) -> str:
    cell = "<t{0} style='text-align:left'>{1}</t{0}>"
    rows = (cell.format("h", escape(name)) + cell.format("d", escape(value)) for name, value in _rows(self))
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return f"<table><caption>{escape(type(self).__name__)}</caption>{body}</table>"
