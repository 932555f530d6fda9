"""Widgets for the settings of a stage, each with its default told and marked."""

from __future__ import annotations

from typing import Any, Literal, get_args, get_origin

import panel as pn
from pydantic import BaseModel
from pydantic.fields import FieldInfo

DEFAULT_MARK = "#D55E00"
_WIDTH = 285


def slider(model: type[BaseModel], name: str, label: str, span: tuple[float, float], step: float) -> Any:
    """Make a slider for a number, with a mark at its default.

    Parameters
    ----------
    label : str
        What the number is, with its unit.
    span : tuple of float
        Least and greatest value.
    """
    default = model.model_fields[name].default
    low, high = span
    share = 100.0 * (default - low) / (high - low)
    kind = pn.widgets.IntSlider if isinstance(default, int) else pn.widgets.FloatSlider
    return kind(
        name=f"{label}, default {default:g}",
        start=type(default)(low),
        end=type(default)(high),
        step=type(default)(step),
        value=default,
        width=_WIDTH,
        margin=(2, 8),
        stylesheets=[mark_at(share)],
    )


def mark_at(share: float) -> str:
    """Style of a slider with a mark at so many per cent of its length."""
    return (
        f".noUi-base::before {{ content: ''; position: absolute; left: calc({share:.2f}% - 1px); top: 13px; "
        f"height: 8px; width: 3px; background: {DEFAULT_MARK}; pointer-events: none; }}"
    )


def widget(model: type[BaseModel], name: str) -> Any:
    """Make a widget for a switch, a choice or a number; its description is the field's."""
    field = model.model_fields[name]
    label = name.replace("_", " ")
    told = {"description": field.description, "margin": (2, 8)}
    if field.default is True or field.default is False:
        return pn.widgets.Checkbox(name=f"{label} ({field.description})", value=field.default, margin=(6, 8))
    if (choices := _choices(field)) is not None:
        named = {f"{each} (default)" if each == field.default else each: each for each in choices}
        return pn.widgets.Select(name=label, options=named, value=field.default, width=_WIDTH, **told)
    return pn.widgets.FloatInput(
        name=f"{label}, default {field.default:g}", value=field.default, width=_WIDTH, **told
    )


def _choices(field: FieldInfo) -> tuple[str, ...] | None:
    return get_args(field.annotation) if get_origin(field.annotation) is Literal else None
