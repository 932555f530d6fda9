"""What is said of a table's columns that nothing is made of: a unit in a name, one axis of three missing."""

from __future__ import annotations

import re
from collections.abc import Iterable

Names = tuple[str, ...]

PLAIN_VECTORS: tuple[Names, ...] = tuple(
    tuple(f"{sensor}_{axis}_{unit}" for axis in "xyz")
    for sensor, unit in (("accelerometer", "m_s2"), ("gyroscope", "rad_s"), ("magnetometer", "au"))
)

_MEASURED = re.compile(r"(acc|gyr|mag)[a-z]*(?:[ _.]?([xyz])(?![a-z]))?", re.ASCII)
_SENSOR_LIKE = re.compile(r"acc|gyr|mag|quat|euler|roll|pitch|yaw|time", re.ASCII)
_MOST_NAMED = 9


def not_understood(names: Names, known: frozenset[str], plain: bool) -> tuple[str, ...]:
    """A note that names the columns that are not known, with the names they might be meant for.

    Parameters
    ----------
    names : tuple of str
        In lower case.
    known : frozenset of str
    plain : bool
        Whether the file is a plain one, that holds nothing else; a program's exports hold much that is not
        wanted, and of them those alone are named that look like a sensor's.
    """
    unknown = [name for name in names if name and name not in known]
    if not plain:
        unknown = [name for name in unknown if _SENSOR_LIKE.match(name)]
    if not unknown:
        return ()
    named = [_with_likely(name) for name in unknown[:_MOST_NAMED]]
    more = (f"and {len(unknown) - _MOST_NAMED} more",) if len(unknown) > _MOST_NAMED else ()
    return (f"columns not understood: {', '.join((*named, *more))}",)


def incomplete(names: Names, groups: Iterable[Names]) -> tuple[str, ...]:
    """Notes of columns that were left out because others that belong to them are missing."""
    notes = []
    for group in groups:
        missing = [name for name in group if name not in names]
        there = [name for name in group if name in names]
        if missing and there:
            notes.append(f"{', '.join(there)} left out: expected {', '.join(missing)} beside")
    return tuple(notes)


def _with_likely(name: str) -> str:
    short = name if len(name) <= 40 else f"{name[:40]}..."
    match = _MEASURED.match(name)
    if match is None or match[2] is None:
        return short
    group = next(names for names in PLAIN_VECTORS if names[0].startswith(match[1]))
    return f"{short} (expected {group['xyz'.index(match[2])]})"
