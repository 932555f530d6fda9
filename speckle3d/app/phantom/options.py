"""What else a calibration is told: widgets for its settings that are no detection."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import panel as pn
from panel.viewable import Viewable

from speckle3d.app.phantom.marked import widget
from speckle3d.app.phantom.work import in_turn
from speckle3d.calibrating.settings import ScanSettings, offset_of

_SHOWN = {
    "plane": ("reflector", "pixel_error", "fixed_pixels"),
    "orientation": ("viewed_from", "level"),
    "wires": ("registration", "fixed_pixels", "beside_mm"),
}


class Options:
    """Widgets for the settings of a method of calibration, folded away.

    Parameters
    ----------
    given : ScanSettings
        To begin with.
    changed : callable
        Called when a value changes.
    """

    def __init__(self, given: ScanSettings, changed: Callable[[], None]) -> None:
        model = type(given)
        self._widgets: dict[str, Any] = {
            name: widget(model, name) for name in (*_SHOWN[given.method], "outlier_sigma")
        }
        for name, each in self._widgets.items():
            each.value = getattr(given, name)
        self._offset = pn.widgets.TextInput(
            name="clock offset: empty (the recording's own), `estimate`, or seconds",
            value="" if given.time_offset_s is None else str(given.time_offset_s),
            width=285,
        )
        for each in (*self._widgets.values(), self._offset):
            each.param.watch(in_turn(changed), "value")

    def values(self) -> dict[str, Any]:
        """The settings as they stand.

        Raises
        ------
        InvalidInputError
            If the clock offset is none.
        """
        values = {name: each.value for name, each in self._widgets.items()}
        return values | {"time_offset_s": offset_of((self._offset.value or "").strip())}

    def view(self) -> Viewable:
        """The widgets, folded away."""
        held = [*self._widgets.values(), self._offset]
        rows = [pn.Row(*held[i : i + 2]) for i in range(0, len(held), 2)]
        return pn.Card(*rows, title="More settings of the calibration", collapsed=True, width=610)
