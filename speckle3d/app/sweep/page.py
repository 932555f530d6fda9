"""The sweep player: frames with a slider."""

from __future__ import annotations

import panel as pn
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure
from panel.viewable import Viewable

from speckle3d.app.folder import Folder
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.sweep import Sweep
from speckle3d.study.images import GreyImages


class SweepPage:
    """Frames of a sweep.

    Parameters
    ----------
    sweep : Sweep
    folder : Folder
        Of its file.
    """

    title = "Sweep"

    def __init__(self, sweep: Sweep, folder: Folder, reconstruction: Reconstruction | None = None) -> None:
        self._sweep, self._folder = sweep, folder
        self._images = GreyImages(sweep, 60.0, clipped=False)

    def view(self) -> Viewable:
        """Frames with a slider."""
        slider = pn.widgets.IntSlider(name="frame", start=0, end=len(self._sweep) - 1)
        plot = figure(width=500, height=600, match_aspect=True)
        image = self._images[0]
        source = ColumnDataSource({"image": [image.T[::-1]]})
        plot.image("image", x=0, y=0, dw=1, dh=1, source=source)

        def show(event: object) -> None:
            source.data = {"image": [self._images[int(slider.value or 0)].T[::-1]]}

        slider.param.watch(show, "value")
        return pn.Column(slider, pn.pane.Bokeh(plot))
