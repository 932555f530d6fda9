"""Keys that move through a sweep, wherever the focus is."""

from __future__ import annotations

from typing import ClassVar

import param
from panel.reactive import ReactiveHTML


class Keys(ReactiveHTML):  # type: ignore[misc]
    """Tells keys that are pressed while the page is seen and no text is being written.

    Attributes
    ----------
    pressed : list of [int, str]
        The last keys, oldest first: how many there were with each, and its name in the browser, with "Shift+"
        before it if held. Changes that come quickly one after the other are told as one.
    """

    pressed = param.List(default=[])

    # Panel waits for so many milliseconds whether more changes come.
    _debounce: ClassVar[int] = 1

    _template = '<div id="anchor" style="width:0;height:0"></div>'

    _scripts: ClassVar[dict[str, str]] = {
        "render": """
          const ours = ["ArrowLeft", "ArrowRight", "PageUp", "PageDown", "Home", "End", " "];
          const writes = (target) => target instanceof HTMLElement && (
            target.isContentEditable || target.tagName === "TEXTAREA" ||
            (target.tagName === "INPUT" && !["button", "checkbox", "radio", "range"].includes(target.type)));
          state.count = 0;
          state.keys = [];
          state.heard = (event) => {
            if (event.ctrlKey || event.altKey || event.metaKey || !ours.includes(event.key)) return;
            if (!anchor.isConnected || anchor.getClientRects().length === 0) return;
            if (writes(event.composedPath()[0])) return;
            // Before a slider or a button takes it for its own.
            event.preventDefault();
            event.stopImmediatePropagation();
            state.count += 1;
            const key = (event.shiftKey ? "Shift+" : "") + event.key;
            state.keys = [...state.keys, [state.count, key]].slice(-64);
            data.pressed = state.keys;
          };
          // A button is pressed when Space comes up again.
          state.kept = (event) => {
            const free = anchor.isConnected && !writes(event.composedPath()[0]);
            if (event.key === " " && free) event.preventDefault();
          };
          window.addEventListener("keydown", state.heard, true);
          window.addEventListener("keyup", state.kept, true);
        """,
        "remove": """
          window.removeEventListener("keydown", state.heard, true);
          window.removeEventListener("keyup", state.kept, true);
        """,
    }
