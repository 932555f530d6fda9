"""Keys that move through a sweep, wherever the focus is."""

from __future__ import annotations

from typing import ClassVar

import param
from panel.reactive import ReactiveHTML


class Keys(ReactiveHTML):  # type: ignore[misc]
    """Tells keys that were pressed while the page is seen and no text is being written.

    Attributes
    ----------
    pressed : str
        The last key, by its name in the browser, with "Shift+" before it if held, and a count behind, so that
        the same key twice is two.
    """

    pressed = param.String(default="")

    _template = '<div id="anchor" style="width:0;height:0"></div>'

    _scripts: ClassVar[dict[str, str]] = {
        "render": """
          const ours = ["ArrowLeft", "ArrowRight", "PageUp", "PageDown", "Home", "End", " "];
          const writes = (target) => target instanceof HTMLElement && (
            target.isContentEditable || target.tagName === "TEXTAREA" ||
            (target.tagName === "INPUT" && !["button", "checkbox", "radio", "range"].includes(target.type)));
          state.count = 0;
          state.heard = (event) => {
            if (event.ctrlKey || event.altKey || event.metaKey || !ours.includes(event.key)) return;
            if (!anchor.isConnected || anchor.getClientRects().length === 0) return;
            if (writes(event.composedPath()[0])) return;
            // Before a slider or a button takes it for its own.
            event.preventDefault();
            event.stopImmediatePropagation();
            state.count += 1;
            data.pressed = (event.shiftKey ? "Shift+" : "") + event.key + " " + state.count;
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
