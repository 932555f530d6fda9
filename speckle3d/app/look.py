"""Style of all pages: a line with the file's name, and tabs below it."""

from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from typing import Any, NamedTuple, TypeVar

import panel as pn
from panel.viewable import Viewable

from speckle3d.core.errors import Speckle3DError

_Act = TypeVar("_Act", bound=Callable[..., Any])

STYLE = """
:host {
  --panel-primary-color: #20507a; --panel-on-primary-color: #ffffff; --bokeh-font-size: 13px;
  --panel-background-color: #ffffff; --panel-border-color: #c9d1d9;
  font-family: system-ui, "Segoe UI", "DejaVu Sans", sans-serif; font-size: 13px; color: #1c2730;
}
"""
"""Of the outermost element; what lies within inherits it."""

_HEADER = """
<div style="display:flex;align-items:baseline;gap:14px;background:#1d3347;color:#fff;padding:7px 14px">
<span style="font-weight:600;letter-spacing:.02em">speckle3d</span>
<span style="font-family:ui-monospace,'DejaVu Sans Mono',monospace;overflow:hidden;text-overflow:ellipsis;
white-space:nowrap" title="{name}">{name}</span></div>
"""

_BODY = "html, body { background: #fff; overflow-x: hidden; }"


class Page(NamedTuple):
    """A page, shown as one tab of the app: its title, and what makes its view for a viewer."""

    title: str
    view: Callable[[], Viewable]


batch_changes: Callable[[_Act], _Act] = pn.io.hold()
"""Has the changes of a function sent together; figures may be changed by the event of a widget only so."""


def shell(pages: Sequence[Page], title: str = "") -> Viewable:
    """Pages as tabs below the name of what is looked at, as high as the window; a single one without tabs.

    Without a name, as in a notebook, they have a height of their own. A page's view is made when its tab is
    first opened.
    """
    pn.extension("plotly", raw_css=[_BODY] if title else [])
    header = pn.pane.HTML(_HEADER.format(name=escape(title)), sizing_mode="stretch_width", margin=0)
    return pn.Column(
        *([header] if title else []),
        _tabs(pages),
        stylesheets=[STYLE],
        styles={"height": "100vh" if title else "720px"},
        sizing_mode="stretch_both",
        margin=0,
    )


def _tabs(pages: Sequence[Page]) -> Viewable:
    """Pages as tabs, or a single one, without the line of the app."""
    if len(pages) == 1:
        return _view(pages[0])
    opening = "Opening ... (the first time after an installation: up to a minute)"
    parts = [_view(pages[0]), *(_message(opening) for _ in pages[1:])]
    views = [pn.Column(part, sizing_mode="stretch_both", margin=0) for part in parts]
    tabs = pn.Tabs(*zip((page.title for page in pages), views, strict=True), sizing_mode="stretch_both")
    closed = dict(enumerate(pages[1:], 1))

    def make(number: int, page: Page) -> None:
        views[number].objects = [_view(page)]

    def fill(event: Any) -> None:
        if (page := closed.pop(event.new, None)) is not None:
            # When what is there instead has been shown.
            pn.state.execute(partial(make, event.new, page), schedule=True)

    tabs.param.watch(fill, "active")
    return tabs


def _view(page: Page) -> Viewable:
    """A page's view, or why there is none."""
    try:
        return page.view()
    except Speckle3DError as error:
        return _message(str(error))


def _message(words: str) -> Viewable:
    """Words in place of a page."""
    box = "border-left:4px solid #b3541e;background:#fdf3ec;padding:8px 12px;max-width:60em"
    return pn.pane.HTML(f'<div role="status" style="{box}">{escape(words)}</div>', margin=10)
