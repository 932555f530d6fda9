"""The page for a recording of a phantom."""

from functools import partial
from pathlib import Path

from speckle3d.app.look import Page
from speckle3d.app.phantom.lines import LinesViewer
from speckle3d.app.phantom.points import PointsViewer
from speckle3d.calibrating.phantoms import open_phantom, require_frames
from speckle3d.calibrating.settings import ScanSettings, WireSettings


def phantom_page(images: Path, settings: ScanSettings) -> Page:
    """Page of a phantom's recording, which is looked at and calibrated with.

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
    recording = open_phantom(images, settings)
    require_frames(settings, recording)
    is_wires = isinstance(settings, WireSettings)
    make = partial(PointsViewer if is_wires else LinesViewer, recording, images, settings)
    make()  # which refuses what cannot be shown
    return Page("Points" if is_wires else "Lines", lambda: make().view())
