"""The tuner of line detection: the live line under sliders, a region, frames left out, and the calibration.

References
----------
.. [1] R. W. Prager et al., "Rapid calibration for 3-D freehand ultrasound", Ultrasound Med. Biol. 24, 1998,
   figure 16.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource
from panel.viewable import Viewable

from calibration.detection.lines import LineFinder
from calibration.points import Recording
from speckle3d.app.phantom.plots import ORANGE, SKY_BLUE
from speckle3d.app.phantom.viewer import PhantomViewer
from speckle3d.calibrating.settings import OrientationSettings, PlaneSettings, ScanSettings
from speckle3d.core.arrays import AnyArray

_HINT = (
    "In the image: the line found (blue) and the edges that agree with it (orange rings). "
    "Region: drag a box in the image, or write a polygon."
)


class LinesViewer(PhantomViewer):
    """Lines of a plane in the frames of a recording, found as the sliders say; as `PhantomViewer`."""

    detection = ("columns", "smoothing_mm", "threshold", "tolerance_mm", "consensus")

    def __init__(self, recording: Recording, images: Path, settings: ScanSettings) -> None:
        super().__init__(recording, images, settings)
        self._finder: tuple[object, LineFinder] | None = None
        self._line = ColumnDataSource({"column": [], "row": []}, name="line")
        self._inliers = ColumnDataSource({"column": [], "row": []})
        plot = self.frame_plot.plot
        plot.line("column", "row", source=self._line, color=SKY_BLUE, line_width=2)
        plot.scatter("column", "row", source=self._inliers, size=6, line_color=ORANGE, fill_color=None)

    def view(self) -> Viewable:
        """Lay out the sliders and what the plane is, two in a row."""
        names = *self.detection, "reflector"
        controls = [self.widgets[name] for name in names if name in self.widgets]
        return self.layout(pn.GridBox(*controls, ncols=2), pn.pane.HTML(_HINT, width=600))

    def show(self, image: AnyArray, settings: ScanSettings) -> str:
        """Find the line in a frame."""
        self._line.data = self._inliers.data = {"column": [], "row": []}
        assert isinstance(settings, PlaneSettings | OrientationSettings)
        # What is looked at depends on these alone; the rest must follow the slider at once.
        key = settings.columns, settings.smoothing_mm, settings.corners
        if self._finder is None or self._finder[0] != key:
            images, size = self.recording.images, self.recording.pixel_mm
            self._finder = key, LineFinder.of_frames(images, size, settings, settings.corners)
        line = replace(self._finder[1], settings=settings).line(image)
        (u, v), (w, x) = line.points_px
        across = np.array([-0.5, image.shape[0] / 2 - 0.5, image.shape[0] - 0.5])
        rows = v + (x - v) / (w - u) * (across - u)
        self._line.data = {"column": across, "row": rows}
        self._inliers.data = dict(zip(("column", "row"), line.inlier_px.T, strict=True))
        consensus = f"{line.consensus} of {line.possible} columns agree"
        return f"line: {consensus}; row {rows[1]:.2f} in the middle"
