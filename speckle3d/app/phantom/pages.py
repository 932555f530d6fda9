"""Pages for a recording of a phantom."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from speckle3d.app.folder import Folder
from speckle3d.app.page import Page
from speckle3d.app.phantom.lines import LinesPage
from speckle3d.app.phantom.points import PointsPage
from speckle3d.calibrating.phantoms import opened, require_frames
from speckle3d.calibrating.settings import OrientationSettings, PlaneSettings, ScanSettings, WireSettings
from speckle3d.core.errors import InvalidInputError


def phantom_pages(images: Path, settings: ScanSettings) -> Sequence[Page]:
    """Pages on which a recording of a phantom is looked at and calibrated with.

    Parameters
    ----------
    settings : PlaneSettings, OrientationSettings or WireSettings
        Of the calibration, to begin with.

    Raises
    ------
    FileError, InvalidInputError, InsufficientDataError
        If the recording cannot be opened, or what is given does not fit it.
    """
    recording = opened(images, settings, settings.poses)
    if not recording.images.shape[0]:
        raise InvalidInputError(f"{images}: expected frames to look at, got none")
    require_frames(settings.leave_out, recording.images.shape[0])
    folder = Folder(images)
    if isinstance(settings, WireSettings):
        return [PointsPage(recording, images, folder, settings)]
    assert isinstance(settings, PlaneSettings | OrientationSettings)
    return [LinesPage(recording, images, folder, settings)]
