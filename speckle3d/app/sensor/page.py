"""The orientation sensor's log: what it read, and what that says of its heading."""

from __future__ import annotations

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure
from panel.viewable import Viewable

from speckle3d.app.folder import Folder
from xsens.logs.samples import ImuLog


class SensorPage:
    """What an orientation sensor read.

    Parameters
    ----------
    log : ImuLog
    folder : Folder
        Of its file.
    """

    title = "Sensor"

    def __init__(self, log: ImuLog, folder: Folder) -> None:
        self._log, self._folder = log, folder

    def view(self) -> Viewable:
        """Rates and field over time."""
        time_s = self._log.time_s - self._log.time_s[0]
        plots = []
        for name, values in (
            ("rate, deg/s", self._log.gyroscope_rad_s),
            ("field, a.u.", self._log.magnetometer_au),
        ):
            if values is not None:
                plot = figure(height=200, sizing_mode="stretch_width", y_axis_label=name)
                norm = np.linalg.norm(values, axis=1) * (180 / np.pi if name.startswith("rate") else 1.0)
                plot.line("t", "y", source=ColumnDataSource({"t": time_s, "y": norm}))
                plots.append(pn.pane.Bokeh(plot, sizing_mode="stretch_width"))
        return pn.Column(*plots, sizing_mode="stretch_width")
