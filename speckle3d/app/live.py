"""A sweep while it is made: the picture as it comes, the length so far, the path, a cut of the volume."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, DataRange1d, LinearColorMapper
from bokeh.palettes import Greys256
from bokeh.plotting import figure
from panel.viewable import Viewable

from speckle3d.app.look import batched
from speckle3d.app.server import AppServer
from speckle3d.core.arrays import Float32Array
from speckle3d.core.geometry import roll_yaw_tilt
from speckle3d.live.session import Session

_REFRESH_MS = 200
_MOST_POINTS = 600
"""Of the path that are drawn: as many as its plot has pixels."""
_LINES = {"tilt": "#b3261e", "yaw": "#2e7d32"}
_BIG = "font-size:26px;font-weight:600"


class LivePage:
    """What a live session has so far.

    Parameters
    ----------
    session : Session
    status : callable
        Says what there is to say beside: trouble of the connection, the end.
    """

    title = "Live"

    def __init__(self, session: Session, status: Callable[[], str]) -> None:
        self._session, self._status = session, status

    def view(self) -> Viewable:
        """The picture, the volume's cut along the sweep, and the path over time."""
        return _Viewer(self._session, self._status).layout()


@contextmanager
def watched(page: LivePage) -> Iterator[tuple[str, str]]:
    """Serve a page beside the work of a block; yields its address, and one that leads there once."""
    ready, server = threading.Event(), list[AppServer]()

    def serve() -> None:
        asyncio.set_event_loop(asyncio.new_event_loop())
        try:
            server.append(AppServer([page], "live", unseen_s=float("inf")))
        finally:
            ready.set()
        server[0].run()

    thread = threading.Thread(target=serve, name="pages", daemon=True)
    thread.start()
    ready.wait()
    try:
        yield server[0].address, server[0].address_for_once()
    finally:
        server[0].end()
        thread.join()


class _Viewer:
    """What one viewer sees."""

    def __init__(self, session: Session, status: Callable[[], str]) -> None:
        self._session, self._status, self._shown = session, status, (-1, -1)
        self._words = pn.pane.HTML("", sizing_mode="stretch_width", margin=(6, 12))
        self._picture, self._cut = _picture("lateral / mm"), _picture("along the sweep / mm")
        self._path = ColumnDataSource({name: [] for name in ("t", "length", "low", "high", *_LINES)})
        self._refresh()

    def layout(self) -> Viewable:
        """Lay everything out, and begin to follow the session."""
        pn.state.add_periodic_callback(self._refresh, period=_REFRESH_MS)
        length = _plot("length / mm")
        length.varea("t", "low", "high", source=self._path, fill_color="#20507a", fill_alpha=0.25)
        length.line("t", "length", source=self._path, color="#20507a", line_width=2)
        turn = _plot("turn / °", x_range=length.x_range, x_axis_label="time / s")
        for name, colour in _LINES.items():
            turn.line("t", name, source=self._path, color=colour, legend_label=name)
        turn.legend.update(orientation="horizontal", location="top_left", padding=2, margin=2)
        self._cut[0].y_range = self._picture[0].y_range
        shown = [
            pn.pane.Bokeh(plot, sizing_mode="stretch_both", margin=0)
            for plot in (self._picture[0], self._cut[0], length, turn)
        ]
        plots = pn.Column(*shown[2:], sizing_mode="stretch_both")
        row = pn.Row(*shown[:2], plots, sizing_mode="stretch_both")
        return pn.Column(self._words, row, sizing_mode="stretch_both")

    @batched
    def _refresh(self) -> None:
        session = self._session
        progress = session.progress
        self._words.object = "<br>".join(
            [
                f'<span style="{_BIG}">{escape(progress.length)}</span>'
                f" &emsp; {progress.recorded} frames &emsp; {escape(progress.words)}",
                escape("; ".join(filter(None, (self._status(), progress.missing, progress.failed)))),
            ]
        )
        shown = (progress.matched, progress.volumes)
        if shown[0] != self._shown[0]:
            if (picture := session.picture()) is not None:
                levels, grid = picture
                pitch_mm = (grid.vector_pitch_mm, grid.sample_spacing_mm)
                first_mm = (grid.first_vector_mm, grid.first_sample_depth_mm)
                _show(self._picture[1], levels.T, first_mm, pitch_mm)
            self._draw_path()
        if shown[1] != self._shown[1] and (volume := session.voxels) is not None:
            middle = volume.voxels[volume.shape[0] // 2].astype(np.float32)
            _, y_mm, z_mm = volume.world_from_grid.translation.tolist()
            _, dy_mm, dz_mm = volume.spacing_mm
            _show(self._cut[1], middle, (z_mm, y_mm), (dz_mm, dy_mm))
        self._shown = shown

    def _draw_path(self) -> None:
        times, elevation_mm, poses = self._session.path()
        if len(times) < 2:
            return
        few = np.unique(np.linspace(0, len(times) - 1, _MOST_POINTS).astype(int))
        length_mm = elevation_mm[few] - elevation_mm[0]
        half_mm = 1.96 * self._session.progress.length_sigma * np.abs(length_mm)
        _, yaw, tilt = np.rad2deg(roll_yaw_tilt(poses[few].rotation)).T
        self._path.data = {
            "t": times[few] - times[0],
            "length": length_mm,
            "low": length_mm - half_mm,
            "high": length_mm + half_mm,
            "tilt": tilt,
            "yaw": yaw,
        }


def _plot(label: str, **more: Any) -> figure:
    plot = figure(sizing_mode="stretch_both", y_axis_label=label, toolbar_location=None, **more)
    plot.axis.axis_label_text_font_style = "normal"
    return plot


def _picture(across: str) -> tuple[figure, ColumnDataSource]:
    """An empty picture, depth downwards, and what it draws."""
    source = ColumnDataSource({name: [] for name in ("image", "x", "y", "dw", "dh")})
    plot = _plot(
        "depth / mm", x_axis_label=across, match_aspect=True, y_range=DataRange1d(flipped=True), tools=""
    )
    plot.grid.visible = False
    colours = LinearColorMapper(palette=Greys256, low=0.0, high=255.0, nan_color="#e6e9ec")
    plot.image("image", "x", "y", "dw", "dh", source=source, color_mapper=colours)
    return plot, source


def _show(
    source: ColumnDataSource,
    image: Float32Array,
    first_mm: tuple[float, float],
    pitch_mm: tuple[float, float],
) -> None:
    """Draw an image, shape (row, column), whose first pixel and pitch are given as (x, y)."""
    rows, columns = image.shape
    (x, y), (dx, dy) = first_mm, pitch_mm
    source.data = {
        "image": [image],
        "x": [x - dx / 2],
        "y": [y - dy / 2],
        "dw": [columns * dx],
        "dh": [rows * dy],
    }
