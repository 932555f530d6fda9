"""A sweep while it is made: the picture as it comes, the length so far, the path, a cut of the volume."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource
from panel.viewable import Viewable

from speckle3d.app.look import Page, batch_changes
from speckle3d.app.plots import ImagePlot, empty_plot, greys
from speckle3d.app.server import AppServer
from speckle3d.core.geometry import roll_yaw_tilt
from speckle3d.live.session import Session

_REFRESH_MS = 200
_MOST_POINTS = 600
"""Of the path that are drawn: as many as its plot has pixels."""
_LINES = {"tilt": "#b3261e", "yaw": "#2e7d32"}
_BIG = "font-size:26px;font-weight:600"


@contextmanager
def watch(session: Session, status: Callable[[], str]) -> Iterator[tuple[str, str]]:
    """Serve what a session has so far beside the work of a block.

    Parameters
    ----------
    session : Session
    status : callable
        Says what there is to say beside: trouble of the connection, the end.

    Yields
    ------
    tuple of (str, str)
        Its address, and one that leads there once.
    """
    page = Page("Live", lambda: _Viewer(session, status).layout())
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    server = AppServer([page], "live", unseen_s=float("inf"))

    def serve() -> None:
        asyncio.set_event_loop(loop)
        server.run()

    thread = threading.Thread(target=serve, name="pages", daemon=True)
    thread.start()
    try:
        yield server.address, server.address_for_once()
    finally:
        server.end()
        thread.join()


class _Viewer:
    """View of one viewer."""

    def __init__(self, session: Session, status: Callable[[], str]) -> None:
        self._session, self._status, self._counts = session, status, (-1, -1)
        self._words = pn.pane.HTML("", sizing_mode="stretch_width", height=60, margin=(6, 12))
        self._picture, self._cut = ImagePlot("lateral / mm"), ImagePlot("along the sweep / mm")
        self._path = ColumnDataSource({name: [] for name in ("t", "length", "low", "high", *_LINES)})
        self._refresh()

    def layout(self) -> Viewable:
        """Lay everything out, and begin to follow the session."""
        pn.state.add_periodic_callback(self._refresh, period=_REFRESH_MS)
        length = empty_plot("", "length / mm", toolbar_location=None)
        length.varea("t", "low", "high", source=self._path, fill_color="#20507a", fill_alpha=0.25)
        length.line("t", "length", source=self._path, color="#20507a", line_width=2)
        turn = empty_plot("time / s", "turn / °", x_range=length.x_range, toolbar_location=None)
        for name, colour in _LINES.items():
            turn.line("t", name, source=self._path, color=colour, legend_label=name)
        turn.legend.update(orientation="horizontal", location="top_left", padding=2, margin=2)
        self._cut.plot.y_range = self._picture.plot.y_range
        picture, cut, *paths = (
            pn.pane.Bokeh(plot, sizing_mode="stretch_both", margin=0)
            for plot in (self._picture.plot, self._cut.plot, length, turn)
        )
        row = pn.Row(picture, cut, pn.Column(*paths, sizing_mode="stretch_both"), sizing_mode="stretch_both")
        return pn.Column(self._words, row, sizing_mode="stretch_both")

    @batch_changes
    def _refresh(self) -> None:
        session = self._session
        progress = session.progress
        self._words.object = "<br>".join(
            [
                f'<span style="{_BIG}">{escape(progress.length)}</span>'
                f" &emsp; {progress.frames} frames &emsp; {escape(progress.words)}",
                escape("; ".join(filter(None, (self._status(), progress.missing, progress.failure)))),
            ]
        )
        counts = (progress.poses, progress.volumes)
        if counts[0] != self._counts[0]:
            if (picture := session.picture()) is not None:
                levels, grid = picture
                pitch_mm = (grid.vector_pitch_mm, grid.sample_spacing_mm)
                first_mm = (grid.first_vector_mm, grid.first_sample_depth_mm)
                self._picture.show(greys(levels.T, 0.0, 255.0), first_mm, pitch_mm)
            self._draw_path()
        if counts[1] != self._counts[1] and (volume := session.voxels) is not None:
            middle = volume.voxels[volume.shape[0] // 2].astype(np.float32)
            _, y_mm, z_mm = volume.world_from_grid.translation.tolist()
            _, dy_mm, dz_mm = volume.spacing_mm
            self._cut.show(greys(middle, 0.0, 255.0), (z_mm, y_mm), (dz_mm, dy_mm))
        self._counts = counts

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
