"""A page of the app."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from panel.viewable import Viewable


class Page(Protocol):
    """A page, shown as one tab of the app."""

    title: str

    def view(self) -> Viewable:
        """Return what is shown, made anew for every viewer."""


@dataclass
class SimplePage:
    """A page of a function that makes its view."""

    title: str
    view: Callable[[], Viewable]
