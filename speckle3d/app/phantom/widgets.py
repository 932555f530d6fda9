"""Widgets of settings, which have their values, bounds and descriptions."""

from __future__ import annotations

from typing import Any, Literal, get_args, get_origin

import panel as pn
from pydantic import BaseModel

WIDTH_PX = 285
_SLIDERS: dict[str, tuple[str, float, float, float]] = {
    "columns": ("n, columns", 5, 240, 1),
    "smoothing_mm": ("σ, smoothing / mm", 0.05, 3.05, 0.05),
    "threshold": ("T / levels per mm, 0: auto", 0.0, 300.0, 1.0),
    "tolerance_mm": ("d, tolerance / mm", 0.05, 3.05, 0.05),
    "consensus": ("p, share that agrees", 0.05, 1.0, 0.01),
}
"""Label, least, greatest and step of settings that are tuned by sliders."""


def widget(settings: BaseModel, name: str) -> Any:
    """Make the widget of a setting, which has its value; its description is the field's."""
    field, value = type(settings).model_fields[name], getattr(settings, name)
    label, look = name.replace("_", " "), {"width": WIDTH_PX, "margin": (2, 8)}
    options = {"description": field.description, **look}
    if name in _SLIDERS:
        label, low, high, step = _SLIDERS[name]
        kind = pn.widgets.IntSlider if isinstance(field.default, int) else pn.widgets.FloatSlider
        value, default = value or 0.0, field.default or 0.0
        ends = {"start": min(low, value), "end": max(high, value), "step": step}
        return kind(name=f"{label} (default {default:g})", value=value, **ends, **look)
    if isinstance(field.default, bool):
        return pn.widgets.Checkbox(name=field.description, value=value, **look)
    if get_origin(field.annotation) is Literal:
        return pn.widgets.Select(name=label, options=list(get_args(field.annotation)), value=value, **options)
    if isinstance(field.default, float):
        return pn.widgets.FloatInput(name=f"{label} (default {field.default:g})", value=value, **options)
    text = "" if value is None else str(value)
    return pn.widgets.TextInput(name=label, value=text, placeholder=field.description, **look)
