"""Fields of YAML as text: mappings and lists, with nothing that another place of the file decides.

Made of the parser's events, one after another: scalars stay the text that is in the file, so that ``010`` is
ten and not eight; anchors, aliases, tags, and a field that is given twice are refused where they stand, and
nothing of them is built. The scanner writes none.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import extra_module

_UNITS = {
    "": {"": 1.0},
    "Hz": {"hz": 1.0, "khz": 1e3, "mhz": 1e6},
    "mm": {"mm": 1.0, "cm": 10.0, "um": 1e-3, "µm": 1e-3},
    "m/s": {"m/s": 1.0},
    "bytes": {"bytes": 1.0, "byte": 1.0},
    "deg": {"°": 1.0, "deg": 1.0},
}
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d]*)\s*")
_LONGEST_NUMBER = 64
_NOTHING = frozenset({"", "~", "null", "Null", "NULL"})

_DEEPEST = 16
"""Descriptions are five deep."""

_SHOWN = 40
"""Characters of a wrong value that a message shows."""


def documents_of(text: str, where: str) -> Iterator[Mapping[str, Any]]:
    """Parse YAML whose documents are fields; empty ones are left out.

    Yields
    ------
    mapping of str
        To text, to None where there is nothing, to a list, or to another mapping.

    Raises
    ------
    InvalidInputError
        If it is no YAML, holds other things, aliases or a field twice, or PyYAML is not installed.
    """
    yaml = _library()
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    events = yaml.parse(text, Loader=loader)
    try:
        for event in events:
            if not isinstance(event, yaml.DocumentStartEvent):
                continue
            document = _document(yaml, events, where)
            if document is None:
                continue
            if not isinstance(document, dict):
                raise InvalidInputError(f"{where}: expected fields, got {shown(document)}")
            yield document
    except RecursionError:
        raise InvalidInputError(f"{where}: expected YAML, got brackets within brackets without end") from None
    except (yaml.YAMLError, ValueError) as error:
        if isinstance(error, InvalidInputError):
            raise
        told = " ".join(str(error).split())[:200]
        raise InvalidInputError(f"{where}: expected YAML, got an error: {told}") from error


def quantity(value: object, unit: str, where: str) -> float:
    """Read a number with its unit, as ``"60 MHz"``, in the base unit `unit`.

    Raises
    ------
    InvalidInputError
        If it is no finite number, or has another unit or none.
    """
    short = isinstance(value, str) and len(value) <= _LONGEST_NUMBER
    found = _NUMBER.fullmatch(str(value)) if short else None
    factors = _UNITS[unit]
    if found is None or found[2].lower() not in factors or not math.isfinite(float(found[1])):
        expected = f"a number of {unit}" if unit else "a number"
        raise InvalidInputError(f"{where}: expected {expected}, got {shown(value)}")
    return float(found[1]) * factors[found[2].lower()]


def shown(value: object) -> str:
    """Show a wrong value in a message: the beginning of a text, or what else it is."""
    if isinstance(value, str):
        return repr(value[:_SHOWN]) + ("..." if len(value) > _SHOWN else "")
    return "fields" if isinstance(value, dict) else "a list" if isinstance(value, list) else "nothing"


def _document(yaml: Any, events: Iterator[Any], where: str) -> Any:
    """Build one document: a mapping, a list, or text."""
    result: list[Any] = []
    open_ones: list[Any] = [result]
    keys: list[str | None] = [None]
    for event in events:
        line = f"{where}: line {event.start_mark.line + 1}"
        if isinstance(event, yaml.DocumentEndEvent):
            return result[0]
        if isinstance(event, yaml.SequenceEndEvent | yaml.MappingEndEvent):
            open_ones.pop()
            keys.pop()
            continue
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            raise InvalidInputError(f"{line}: expected no anchors and aliases, got one")
        if event.tag is not None:
            raise InvalidInputError(f"{line}: expected no tags, got {shown(event.tag)}")
        inside, key = open_ones[-1], keys[-1]
        is_scalar = isinstance(event, yaml.ScalarEvent)
        if isinstance(inside, dict) and key is None:
            if not is_scalar:
                raise InvalidInputError(f"{line}: expected the name of a field, got a list or fields")
            if event.value in inside:
                raise InvalidInputError(f"{line}: {event.value[:_SHOWN]}: expected it once, got it twice")
            keys[-1] = event.value
            continue
        value: Any = {} if isinstance(event, yaml.MappingStartEvent) else []
        if is_scalar:
            value = None if not event.style and event.value in _NOTHING else event.value
        if isinstance(inside, dict):
            inside[key] = value
            keys[-1] = None
        else:
            inside.append(value)
        if not is_scalar:
            if len(open_ones) > _DEEPEST:
                raise InvalidInputError(f"{line}: expected at most {_DEEPEST} levels of fields, got more")
            open_ones.append(value)
            keys.append(None)
    raise InvalidInputError(f"{where}: expected the end of a document, got none")


def _library() -> Any:
    return extra_module("yaml", "clarius", "a package of a Clarius scanner")
