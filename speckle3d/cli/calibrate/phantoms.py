"""Calibration of a sensor to the image with a phantom, a plane or wires, and how calibrations repeat."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.calibrations import report_written, require_free
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import Json, Out, emit, emit_json, from_options, note
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.calibrating.settings import ScanSettings


def plane(
    images: Path,
    out: Out,
    settings: Annotated[dict[str, Any], Fields("speckle3d.calibrating.settings:PlaneSettings")],
    as_json: Json = False,
) -> None:
    """Calibrate a position sensor with the floor of a water bath, or the Cambridge phantom.

    Parameters
    ----------
    images
    out
        Calibration file to write; .txt and .png beside it.
    reflector, poses, transform, pixel_mm, time_offset_s, validation, as_json

    Examples
    --------
    $ speckle3d calibrate plane bath.h5 -o tracker.h5 --reflector bar
    """
    from speckle3d.calibrating.settings import PlaneSettings

    _calibrate(images, from_options(PlaneSettings, settings), out, as_json)


def orientation(
    images: Path,
    out: Out,
    settings: Annotated[dict[str, Any], Fields("speckle3d.calibrating.settings:OrientationSettings")],
    as_json: Json = False,
) -> None:
    """Calibrate an orientation sensor with the floor of a water bath.

    Parameters
    ----------
    images
    out
        Calibration file to write; .txt and .png beside it.
    sensor, level, viewed_from, poses, time_offset_s, validation, as_json

    Examples
    --------
    $ speckle3d calibrate orientation bath.h5 -o imu.h5
    """
    from speckle3d.calibrating.settings import OrientationSettings

    _calibrate(images, from_options(OrientationSettings, settings), out, as_json)


def wires(
    images: Path,
    out: Out,
    phantom: Annotated[str, typer.Option()],
    settings: Annotated[dict[str, Any], Fields("speckle3d.calibrating.settings:WireSettings")],
    as_json: Json = False,
) -> None:
    """Calibrate a position sensor with crossing wires, three orthogonal wires or N-shapes.

    Parameters
    ----------
    images
    out
        Calibration file to write; .txt, .png and .csv beside it.
    phantom
        cross, three, or a PLUS configuration of N-wires.
    points, poses, transform, pixel_mm, time_offset_s, as_json

    Examples
    --------
    $ speckle3d calibrate wires scan.mha -o tracker.h5 --phantom cross
    """
    from speckle3d.calibrating.settings import WireSettings

    _calibrate(images, from_options(WireSettings, {**settings, "phantom": phantom}), out, as_json)


def _calibrate(images: Path, settings: ScanSettings, out: Path, as_json: bool) -> None:
    """Calibrate, check on the other recording, and write the calibration, its report and the dots."""
    from speckle3d.calibrating.phantoms import found, opened, remarks, solved, validated, write_outcome

    if settings.validation is None and getattr(settings, "validation_points", None) is not None:
        raise InvalidInputError("--validation-points: expected the recording in --validation, got none")
    files = [getattr(settings, name, None) for name in ("points", "validation_points", "phantom")]
    others = [None if file is None else Path(file) for file in files]
    require_free(out, images, settings.poses, settings.validation, *others)
    recording = opened(images, settings)
    with progress_bar(f"looking into {images.name}") as progress, naming(str(images)):
        seen = found(recording, settings, progress)
    with naming(str(images)):
        outcome = solved(recording, seen, settings)
    notes = remarks(outcome)
    if settings.validation is not None:
        with progress_bar(f"looking into {settings.validation.name}") as progress:
            notes += validated(outcome, settings, progress)
    written = write_outcome(outcome, settings, images, out, notes)
    report_written(written, notes, outcome.beam, as_json)


def repeatability(
    calibrations: list[Path], size_px: tuple[int, int] | None = None, as_json: Json = False
) -> None:
    """Compare repeated calibrations: scatter of roll, yaw and tilt, and of the image's centre and corners.

    Parameters
    ----------
    calibrations
        Calibration files of one mounting.
    size_px
        Columns and rows of the image, for centre and corners.
    as_json

    Examples
    --------
    $ speckle3d calibrate repeatability first.h5 second.h5 third.h5
    """
    import numpy as np

    from calibration.repeatability import repeatability as repeated
    from speckle3d.io.calibrations import read_calibration

    found = repeated([read_calibration(path) for path in calibrations], size_px)
    angles = np.rad2deg(found.roll_yaw_tilt_sd_rad).tolist()
    shifts = found.centre_shift_mm
    if as_json:
        table = {
            "trials": found.trials,
            "roll_yaw_tilt_sd_deg": angles,
            "centre_sd_mm": found.centre_sd_mm,
            "corner_sd_mm": found.corner_sd_mm,
            "centre_shift_mm": None if shifts is None else shifts.tolist(),
        }
        emit_json(table)
        return
    emit(f"standard deviation over {found.trials} calibrations")
    emit("  roll {:.3f}, yaw {:.3f}, tilt {:.3f} deg".format(*angles))
    if shifts is None:
        note("with --size-px COLUMNS ROWS also the scatter of the image's centre and corners")
        return
    emit(f"  centre {found.centre_sd_mm:.3f} mm, corners {found.corner_sd_mm:.3f} mm")
    emit(f"centre against the first calibration: {', '.join(f'{shift:.2f}' for shift in shifts)} mm")
