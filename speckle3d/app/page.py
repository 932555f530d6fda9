"""A page of the app."""

from __future__ import annotations

from typing import Protocol

from panel.viewable import Viewable


class Page(Protocol):
    """What one tab of the app shows.

    One that needs parts of Panel which are loaded by name, as ``plotly``, has them as `extensions`.
    """

    title: str

    def view(self) -> Viewable:
        """Return what is shown, made anew for every viewer."""
