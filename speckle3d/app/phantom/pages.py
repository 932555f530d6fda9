"""The page for a recording of a phantom."""

from __future__ import annotations

from pathlib import Path

from panel.viewable import Viewable

from speckle3d.app.phantom.lines import LinesViewer
from speckle3d.app.phantom.points import PointsViewer
from speckle3d.calibrating.phantoms import open_phantom, require_frames
from speckle3d.calibrating.settings import ScanSettings, WireSettings
from speckle3d.core.errors import InvalidInputError


class PhantomPage:
    """A recording of a phantom that is looked at and calibrated with.

    Parameters
    ----------
    images : Path
        The recording, as the command is given it.
    settings : PlaneSettings, OrientationSettings or WireSettings
        Of the calibration, to begin with.

    Raises
    ------
    FileError, InvalidInputError, InsufficientDataError
        If the recording cannot be opened, or phantom, points or frames of the settings do not fit it.
    """

    def __init__(self, images: Path, settings: ScanSettings) -> None:
        recording = open_phantom(images, settings)
        if not recording.images.shape[0]:
            raise InvalidInputError(f"{images}: expected frames to look at, got none")
        require_frames(settings.frames_left_out, recording.images.shape[0])
        self._inputs = recording, images, settings
        self._viewer = PointsViewer if isinstance(settings, WireSettings) else LinesViewer
        self.title = "Points" if isinstance(settings, WireSettings) else "Lines"
        self._viewer(*self._inputs)  # which refuses what cannot be shown

    def view(self) -> Viewable:
        """Return the page of one viewer."""
        return self._viewer(*self._inputs).view()
