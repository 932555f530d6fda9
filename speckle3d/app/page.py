"""A page of the app."""

from __future__ import annotations

from typing import Protocol

from panel.viewable import Viewable


class Page(Protocol):
    """What one tab of the app shows."""

    title: str

    def view(self) -> Viewable:
        """Return what is shown, made anew for every viewer."""
