"""Pages for a recording of a phantom."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from panel.viewable import Viewable

from calibration.points import Recording
from speckle3d.app.folder import Folder
from speckle3d.app.page import Page
from speckle3d.app.phantom.lines import LinesViewer
from speckle3d.app.phantom.points import PointsViewer
from speckle3d.calibrating.phantoms import opened, require_frames
from speckle3d.calibrating.settings import ScanSettings, WireSettings
from speckle3d.core.errors import InvalidInputError


class PhantomPage:
    """A recording of a phantom that is looked at and calibrated with.

    Parameters
    ----------
    recording : Recording
    images : Path
        Its file, as the command is given it.
    settings : PlaneSettings, OrientationSettings or WireSettings
        Of the calibration, to begin with.

    Raises
    ------
    FileError, InvalidInputError
        If the phantom or points of the settings cannot be read, or do not fit the recording.
    """

    def __init__(self, recording: Recording, images: Path, settings: ScanSettings) -> None:
        self._given = recording, images, Folder(images), settings
        self._viewer = PointsViewer if isinstance(settings, WireSettings) else LinesViewer
        self.title = "Points" if isinstance(settings, WireSettings) else "Lines"
        self._viewer(*self._given)  # which refuses what cannot be shown

    def view(self) -> Viewable:
        """Return the page of one viewer."""
        return self._viewer(*self._given).view()


def phantom_pages(images: Path, settings: ScanSettings) -> Sequence[Page]:
    """Pages on which a recording of a phantom is looked at and calibrated with.

    Raises
    ------
    FileError, InvalidInputError, InsufficientDataError
        If the recording cannot be opened, or what is given does not fit it.
    """
    recording = opened(images, settings)
    if not recording.images.shape[0]:
        raise InvalidInputError(f"{images}: expected frames to look at, got none")
    require_frames(settings.frames_left_out, recording.images.shape[0])
    return [PhantomPage(recording, images, settings)]
