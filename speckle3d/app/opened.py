"""Choose the pages of a file."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

import speckle3d as s3
import xsens
from speckle3d.app.look import Page
from speckle3d.core.errors import Doubt, InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.io.family.reconstructions import FORMAT
from speckle3d.io.hdf5 import SIGNATURE
from speckle3d.io.import_settings import MissingSettingsError
from speckle3d.io.load import kind_of
from speckle3d.io.readers import find_reader, first_bytes

RECONSTRUCTION = "reconstruction.h5"
"""File of a results folder."""


def pages_of(
    path: Path,
    reconstruction: Path | None = None,
    sweep: Path | None = None,
    settings: s3.ImportSettings | None = None,
) -> Sequence[Page]:
    """Pages for what a file or folder holds.

    Parameters
    ----------
    path : path
        A recording, a reconstruction or its results folder, or a log of the orientation sensor.
    reconstruction : path, optional
        Of the recording, to be seen with it.
    sweep : path, optional
        The sweep of a reconstruction, if it moved.
    settings : ImportSettings, optional
        What a recording does not say.

    Raises
    ------
    FileError
        If it cannot be read.
    InvalidInputError
        If the app has no page for it.
    MismatchError
        If reconstruction and recording do not belong together.
    """
    place = path / RECONSTRUCTION if (path / RECONSTRUCTION).is_file() else path
    if find_reader(place) is not None:
        if reconstruction is not None:
            return _result_pages(reconstruction, place, place)
        return _recording_pages(place, settings)
    if reconstruction is not None:
        raise InvalidInputError(f"{path}: expected a recording beside --reconstruction, got something else")
    if first_bytes(place).startswith(SIGNATURE):
        if (kind := kind_of(place)) != FORMAT:
            raise InvalidInputError(f"{path}: expected a recording, a reconstruction or a log, got {kind}")
        return _result_pages(place, sweep, place)
    if path.is_dir():
        raise InvalidInputError(
            f"{path}: expected a recording, a log, or a results folder with {RECONSTRUCTION}, got another"
        )
    return [_sensor(xsens.read_log(path))]


@contextmanager
def open_pages(path: Path, record: Path | None = None, **of_file: Any) -> Iterator[Sequence[Page]]:
    """Pages of a file, as `pages_of` has them, or of a sensor on a serial port, which runs during the block.

    Raises
    ------
    FileError
        Also if no sensor answers on the port, or what it sends cannot be recorded.
    InvalidInputError
        Also if a file is to be recorded.
    """
    if path.is_char_device() or re.fullmatch(r"COM\d+", str(path), re.IGNORECASE):
        from speckle3d.app.sensor.page import sensor_page
        from speckle3d.app.sensor.watch import SensorWatch

        watch = SensorWatch(str(path), record)
        with watch.recording():
            yield [sensor_page(watch)]
        return
    if record is not None:
        raise InvalidInputError(f"{path}: expected a serial port beside --record, got something else")
    yield pages_of(path, **of_file)


def _recording_pages(path: Path, settings: s3.ImportSettings | None) -> list[Page]:
    """Pages of a recording; of a package with a sensor's samples but no frames, the sensor's alone."""
    from speckle3d.sensor_logs import held_log

    try:
        sweep = s3.load_sweep(path, settings)
    except MissingSettingsError:
        raise
    except InvalidInputError as error:
        with suppress(InvalidInputError, InsufficientDataError):
            if (log := held_log(path)) is not None:
                return [_sensor(replace(log, notes=(*log.notes, f"frames are not shown: {error}")))]
        raise
    return _sweep_pages(sweep, path)


def _sweep_pages(
    sweep: s3.Sweep,
    path: Path,
    reconstruction: s3.Reconstruction | None = None,
    doubts: Sequence[Doubt] | None = None,
) -> list[Page]:
    from speckle3d.app.sweep.page import SweepPage
    from speckle3d.sensor_logs import log_of

    pages = [Page("Sweep", SweepPage(sweep, reconstruction, doubts).view)]
    if sweep.orientation is not None:
        pages.append(_sensor(log_of(sweep.orientation, path.name), sweep.orientation.sensor_from_image))
    return pages


def _result_pages(path: Path, sweep_file: Path | None, file: Path) -> list[Page]:
    from speckle3d.app.reconstruction.page import ReconstructionPage
    from speckle3d.scoring.modes import default_mode
    from speckle3d.study.images import open_reconstruction
    from speckle3d.study.results import recorded_doubts

    result, sweep = open_reconstruction(path, sweep_file)
    result = replace(result, pairs=s3.load_reconstruction(path).pairs)
    pages = _sweep_pages(sweep, file, result, recorded_doubts(path, result.provenance))
    mode = "image"
    with suppress(MismatchError):  # modes disagree: all can be looked at
        mode = default_mode(result)[0]
    viewer = Page("Reconstruction", ReconstructionPage(result, sweep, mode).view)
    # First what was asked for.
    return [viewer, *pages] if file == path else [pages[0], viewer, *pages[1:]]


def _sensor(log: xsens.ImuLog, mounting: Rotation | None = None) -> Page:
    from speckle3d.app.sensor.log import LogReadings
    from speckle3d.app.sensor.page import sensor_page

    return sensor_page(LogReadings(log), mounting)
