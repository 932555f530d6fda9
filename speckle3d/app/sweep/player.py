"""One viewer's player of a sweep."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from html import escape

import numpy as np
import panel as pn
import param
from panel.viewable import Viewable

from speckle3d.app.sweep.findings import FrameFindings
from speckle3d.app.sweep.keys import Keys
from speckle3d.app.sweep.pairs import PatchValues, SweepPairs, nearest_lag
from speckle3d.app.sweep.picture import COLOURINGS, PatchCount, Picture
from speckle3d.app.sweep.screen import RANGES_DB, USUAL_DB, ScreenImages
from speckle3d.app.sweep.streams import Stream
from speckle3d.app.sweep.timeline import FLAGGED, TimeLine
from speckle3d.core.sweep import Sweep

LEAP = 10
"""Frames by which Shift and an arrow move."""
_KEYS = '<span style="color:#57636f">&larr; &rarr; (Shift: ten), Home, End, Space; click below to jump</span>'
_TICK_MS = 15
_PATIENCE_S = 1.0
"""A browser that has not drawn for so long is sent the next image all the same."""
_JUDGING_S = 0.02
"""Time at once for looking at frames while nothing plays."""


class Player:
    """What one viewer sees of a sweep, and at which frame.

    Parameters
    ----------
    sweep : Sweep
    images : ScreenImages
    pairs : SweepPairs
    findings : FrameFindings
    streams : dict of str to list of Stream
    """

    def __init__(
        self,
        sweep: Sweep,
        images: ScreenImages,
        pairs: SweepPairs,
        findings: FrameFindings,
        streams: dict[str, list[Stream]],
    ) -> None:
        self._sweep, self._images, self._pairs, self._findings = sweep, images, pairs, findings
        self._streams = streams
        self.frame = 0
        self._shown, self._count, self._sent_s = -1, 0, -np.inf
        self._lag, self._began, self._filling = -1, (0.0, 0.0), False
        self._keys_heard = 0
        self._pair: Compared | None = None
        last = len(sweep) - 1
        self._picture = Picture(images.extent_mm(), pairs.patch_mm)
        self._line = TimeLine(sweep.frame_time_s, self.go)
        self._slider = pn.widgets.IntSlider(
            name="frame",
            start=0,
            end=max(last, 1),
            disabled=last == 0,
            sizing_mode="stretch_width",
            margin=(5, 20, 5, 10),
        )
        self._play = pn.widgets.Toggle(name="▶ play", width=80, margin=(12, 5), disabled=last == 0)
        self._range = pn.widgets.IntSlider(
            name="dynamic range (dB)", start=RANGES_DB[0], end=RANGES_DB[1], value=USUAL_DB, width=150
        )
        colourings = list(COLOURINGS) if pairs.are_reconstructed else ["correlation"]
        self._colouring = pn.widgets.RadioButtonGroup(
            options=["none", *colourings], value=colourings[0] if pairs.are_reconstructed else "none",
            button_type="default", button_style="outline",
        )  # fmt: skip
        self._other = pn.widgets.Select(options={}, width=230, disabled=True)
        self._opacity = pn.widgets.IntSlider(
            name="opacity (%)", start=10, end=100, step=10, value=50, width=150
        )
        self._told = pn.pane.HTML("", sizing_mode="stretch_width")
        self._judged = pn.pane.HTML("", sizing_mode="stretch_width")
        self._keys = Keys(width=0, height=0, margin=0)

    def view(self) -> Viewable:
        """Return what is shown."""
        self._slider.param.watch(self._slid, "value")
        self._play.param.watch(self._started, "value")
        self._keys.param.watch(self._heard, "pressed")
        self._range.param.watch(self._again, "value")
        self._opacity.param.watch(self._again, "value")
        self._colouring.param.watch(self._again, "value")
        self._other.param.watch(self._compared, "value")
        self._picture.drawn.on_change("data", self._has_drawn)
        self._told_of_findings()
        self._draw()
        page = self._laid_out()
        pn.state.add_periodic_callback(self._tick, period=_TICK_MS)
        return page

    def go(self, frame: int) -> None:
        """Show a frame, as soon as the browser has drawn the one before; what plays goes on from there."""
        self.frame = int(np.clip(frame, 0, len(self._sweep) - 1))
        self._began = (time.monotonic(), float(self._sweep.frame_time_s[self.frame]))
        self._draw_wanted()

    def _laid_out(self) -> Viewable:
        chosen = pn.Column(
            pn.pane.HTML("<b>Patches coloured by</b>", margin=(5, 10, 0, 10)),
            self._colouring,
            pn.Row(pn.pane.HTML("of the pair with", margin=(12, 2, 0, 10)), self._other),
            pn.Row(self._opacity, *([self._range] if self._images.of_echoes else [])),
            width=410,
        )
        # Beside what stretches, a plot alone would stretch as well.
        picture = pn.Column(pn.pane.Bokeh(self._picture.plot, margin=0), margin=0)
        found = pn.Column(
            self._told,
            self._judged,
            self._doubts(),
            sizing_mode="stretch_width",
        )
        below = self._line.streams(self._streams) or [
            pn.pane.HTML("No sensor was recorded with this sweep.", margin=(5, 10))
        ]
        return pn.Column(
            pn.Row(picture, chosen, found, sizing_mode="stretch_width"),
            pn.Row(self._play, self._slider, self._keys, sizing_mode="stretch_width", margin=0),
            pn.pane.HTML(_KEYS, margin=(0, 10)),
            pn.pane.Bokeh(self._line.marks, sizing_mode="stretch_width", margin=0),
            pn.Row(*below, sizing_mode="stretch_width"),
            sizing_mode="stretch_width",
            margin=0,
        )

    def _doubts(self) -> Viewable:
        """What is doubted of the recording, with buttons that lead to the frames of each."""
        doubts = self._findings.doubts
        if not self._findings.are_of_reconstruction and not self._streams:
            return pn.Column()
        kept = self._findings.are_of_reconstruction
        heading = (
            "What the checks found (purple below)"
            if kept
            else "What the sensors' readings say against themselves"
        )
        rows: list[Viewable] = [pn.pane.HTML(f"<b>{heading}</b>", margin=(0, 10))]
        if not doubts:
            rows.append(pn.pane.HTML("Nothing in doubt.", margin=(0, 10)))
        for doubt in doubts:
            rows.append(pn.pane.HTML(f"&bull; {escape(doubt.consequence)}", margin=(0, 10)))
            buttons = [
                self._leading_to(first, f"frame {first}" if first == last else f"frames {first}–{last}")
                for first, last in doubt.frames[:8]
            ]
            rows += [pn.Row(*buttons)] if buttons else []
        return pn.Column(*rows, sizing_mode="stretch_width")

    def _leading_to(self, frame: int, name: str) -> Viewable:
        button = pn.widgets.Button(name=name, button_style="outline", height=24, margin=(0, 3))
        button.on_click(partial(lambda frame, _: self.go(frame), frame))
        return button

    def _slid(self, event: param.parameterized.Event) -> None:
        if event.new != self._shown:
            self.go(event.new)

    def _heard(self, event: param.parameterized.Event) -> None:
        # Counted anew where the page was left and opened again.
        last = event.new[-1][0] if event.new else 0
        known = self._keys_heard if self._keys_heard <= last else 0
        self._keys_heard = last
        for count, key in event.new:
            if count > known:
                self._pressed(key)

    def _pressed(self, key: str) -> None:
        held, _, name = key.rpartition("+")
        step = LEAP if held else 1
        if name == " ":
            self._play.value = not self._play.value
        elif name in ("Home", "End"):
            self.go(0 if name == "Home" else len(self._sweep) - 1)
        elif name in ("ArrowLeft", "ArrowRight"):
            self.go(self.frame + (step if name == "ArrowRight" else -step))
        elif name in ("PageUp", "PageDown"):
            self.go(self.frame + (LEAP if name == "PageDown" else -LEAP))

    def _started(self, _: object) -> None:
        self._play.name = "❚❚ pause" if self._play.value else "▶ play"
        if self._play.value:
            self.go(0 if self.frame == len(self._sweep) - 1 else self.frame)

    def _tick(self) -> None:
        """Go on playing at the recording's own rate, or look at more frames."""
        if self._play.value:
            at, from_s = self._began
            now = from_s + time.monotonic() - at
            self.frame = int(np.searchsorted(self._sweep.frame_time_s, now, side="right")) - 1
            if self.frame == len(self._sweep) - 1:
                self._play.value = False
        elif self._findings.flags is None:
            until = time.monotonic() + _JUDGING_S
            while self._findings.flags is None and time.monotonic() < until:
                self._findings.judge_next()
            self._told_of_findings()
        self._draw_wanted()

    def _draw_wanted(self) -> None:
        """Draw the frame that is wanted if the browser has drawn the last one."""
        drawn = int(self._picture.drawn.data["count"][0])
        waited = time.monotonic() - self._sent_s
        if self.frame != self._shown and (drawn >= self._count or waited > _PATIENCE_S):
            self._draw()

    def _has_drawn(self, _: str, __: object, ___: object) -> None:
        self._draw_wanted()

    def _again(self, _: object) -> None:
        self._draw()

    def _compared(self, _: object) -> None:
        if not self._filling and self._other.value is not None:
            self._lag = int(self._other.value) - self.frame
            self._draw()

    def _draw(self) -> None:
        frame = self.frame
        image = self._images.image(frame, int(self._range.value or USUAL_DB))
        with pn.io.hold():
            self._count += 1
            self._shown, self._sent_s = frame, time.monotonic()
            self._picture.show(image, self._count)
            self._slider.value = frame
            self._line.move(frame)
            self._pair = self._draw_patches(frame)
            self._told.object = self._words(frame, self._pair)

    def _draw_patches(self, frame: int) -> Compared | None:
        by = str(self._colouring.value)
        others = self._pairs.others(frame)
        other = nearest_lag(frame, others, self._lag)
        if by == "none" or other is None:
            self._other.disabled = True
            self._picture.clear()
            return None
        self._other.disabled = False
        self._filling = True
        self._other.param.update(options={_named(each, frame): each for each in others}, value=other)
        self._filling = False
        values = self._pairs.values(frame, other, by == "correlation")
        most = dict(zip(COLOURINGS, (*self._pairs.most_mm(abs(other - frame)), 1.0), strict=True))[by]
        count = self._picture.colour(values, by, most, float(self._opacity.value or 0) / 100)
        return Compared(other, values, count)

    def _words(self, frame: int, compared: Compared | None) -> str:
        """What is shown, as HTML."""
        time_s, last = self._sweep.frame_time_s, len(self._sweep) - 1
        lines = [f"<b>Frame {frame}</b> of 0 to {last}, at {time_s[frame] - time_s[0]:.3f} s"]
        reasons = self._findings.reasons(frame)
        lines += [f'<span style="color:{FLAGGED}">&#9873; {escape(reason)}</span>' for reason in reasons]
        if self._findings.flags is not None and not reasons:
            lines.append("no flag")
        if self._colouring.value != "none":
            lines += [_pair_words(compared, self._pairs)]
        return "<br>".join(lines)

    def _told_of_findings(self) -> None:
        self._line.mark(self._findings.flags, self._findings.doubts)
        self._judged.object = escape(self._findings.state())
        if self._findings.flags is not None and self._shown >= 0:
            self._told.object = self._words(self._shown, self._pair)


@dataclass(frozen=True)
class Compared:
    """The pair whose patches are shown."""

    other: int
    values: PatchValues
    count: PatchCount


def _pair_words(compared: Compared | None, pairs: SweepPairs) -> str:
    if compared is None:
        return "There is no other frame."
    values, count = compared.values, compared.count
    words = [f"<b>With frame {compared.other}</b>"]
    if values.moved_mm is not None:
        moved, sigma = values.moved_mm
        words.append(f"the image's centre is {moved:.3f} &plusmn; {sigma:.3f} mm away, elevational")
    if np.isfinite(values.correlation).any():
        words.append(f"median correlation {np.nanmedian(values.correlation):.3f}, computed anew")
    lines = ["; ".join(words) + "."]
    if values.used is None and pairs.are_reconstructed:
        lines.append("The reconstruction did not use this pair.")
    elif values.used is not None:
        why = "the sensed orientation contradicts them" if pairs.by_orientation else "left out of the plane"
        kept = "in the consistent subset" if pairs.by_orientation else "in the plane"
        lines.append(
            f"{count.used} patches {kept} (white frames), "
            f'<span style="color:#c22">{count.rejected} rejected: {why} (red, crossed out)</span>, '
            f"{count.without} without a distance (empty)."
        )
    return "<br>".join(lines)


def _named(other: int, frame: int) -> str:
    return f"frame {other} ({abs(other - frame)} {'before' if other < frame else 'after'})"
