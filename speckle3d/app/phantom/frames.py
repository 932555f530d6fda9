"""Which frame is looked at, and which frames are left out by hand."""

from __future__ import annotations

from collections.abc import Callable

import panel as pn
from panel.viewable import Viewable

from speckle3d.app.phantom.strip import FrameStrip
from speckle3d.calibrating.phantoms import require_frames
from speckle3d.calibrating.settings import frames_of, frames_text
from speckle3d.core.errors import Speckle3DError


class FrameChoice:
    """A slider over frames, a strip of all of them, and what is left out: by a click or as text.

    Parameters
    ----------
    count : int
        Frames of the recording.
    left_out : tuple of int
        To begin with.
    shown, changed : callable
        Called when another frame is looked at, and when other frames are left out.
    """

    def __init__(
        self,
        count: int,
        width: int,
        left_out: tuple[int, ...],
        shown: Callable[[], None],
        changed: Callable[[], None],
    ) -> None:
        self._count, self._shown, self._changed = count, shown, changed
        self._left_out = set(left_out)
        self.strip = FrameStrip(count, width, self.go, self._toggle)
        self.strip.leave_out(left_out)
        # A slider needs two values.
        self.slider = pn.widgets.IntSlider(
            name="frame", start=0, end=max(count - 1, 1), width=width, disabled=count < 2
        )
        self._toggle_one = pn.widgets.Toggle(width=170)
        self._text = pn.widgets.TextInput(
            placeholder="left out, as 3,17-20", value=frames_text(left_out), width=200
        )
        self._complaint = pn.pane.HTML("", margin=(8, 4))
        self.slider.param.watch(lambda event: self._look(), "value")
        self._toggle_one.param.watch(self._clicked, "value")
        self._text.param.watch(self._typed, "value")
        self._name_toggle()

    @property
    def frame(self) -> int:
        """Number of the frame that is looked at."""
        return int(self.slider.value or 0)

    @property
    def left_out(self) -> tuple[int, ...]:
        """Frames that are left out, ascending."""
        return tuple(sorted(self._left_out))

    def go(self, frame: int) -> None:
        """Look at another frame."""
        self.slider.value = frame

    def below(self) -> Viewable:
        """The strip, and what is left out."""
        return pn.Column(
            pn.pane.Bokeh(self.strip.plot), pn.Row(self._toggle_one, self._text, self._complaint)
        )

    def _look(self) -> None:
        self.strip.point_at(self.frame)
        self._name_toggle()
        self._shown()

    def _name_toggle(self) -> None:
        out = self.frame in self._left_out
        name = f"Frame {self.frame} is left out" if out else f"Leave out frame {self.frame}"
        self._toggle_one.param.update(name=name, value=out)

    def _clicked(self, event: object) -> None:
        # The value follows the frame, too.
        if self._toggle_one.value != (self.frame in self._left_out):
            self._toggle(self.frame)

    def _toggle(self, frame: int) -> None:
        self._take_out(self._left_out ^ {frame})

    def _typed(self, event: object) -> None:
        try:
            frames = frames_of(self._text.value)
            require_frames(frames, self._count)
        except Speckle3DError as error:
            self._complaint.object = str(error)
            return
        if set(frames) != self._left_out:
            self._take_out(set(frames))

    def _take_out(self, frames: set[int]) -> None:
        self._left_out, self._complaint.object = frames, ""
        self._text.value = frames_text(frames)
        self.strip.leave_out(self.left_out)
        self._name_toggle()
        self._changed()
