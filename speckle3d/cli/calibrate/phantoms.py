"""Calibration of a sensor to the image with a phantom, a plane or wires, and how calibrations repeat."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import speckle3d as s3
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import Out, Result, note, report_of
from speckle3d.core.errors import naming

if TYPE_CHECKING:
    from speckle3d.calibrating.settings import ScanSettings


def plane(
    images: Path,
    out: Annotated[Out, "calibration"],
    settings: Annotated[Any, Fields("speckle3d.calibrating.settings:PlaneSettings")],
) -> Result:
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
    return _calibrate(images, settings, out)


def orientation(
    images: Path,
    out: Annotated[Out, "calibration"],
    settings: Annotated[Any, Fields("speckle3d.calibrating.settings:OrientationSettings")],
) -> Result:
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
    return _calibrate(images, settings, out)


def wires(
    images: Path,
    out: Annotated[Out, "calibration"],
    settings: Annotated[Any, Fields("speckle3d.calibrating.settings:WireSettings")],
) -> Result:
    """Calibrate a position sensor with crossing wires, three orthogonal wires or N-shapes.

    Parameters
    ----------
    images
    out
        Calibration file to write; .txt, .png and .csv beside it.
    phantom, points, poses, transform, pixel_mm, time_offset_s, as_json

    Examples
    --------
    $ speckle3d calibrate wires scan.mha -o tracker.h5 --phantom cross
    """
    return _calibrate(images, settings, out)


def _calibrate(images: Path, settings: ScanSettings, out: Path) -> Result:
    """Calibrate, check on the other recording, and write the calibration, its report and the dots."""
    from speckle3d.calibrating.phantoms import (
        detect_phantom,
        open_phantom,
        remarks,
        solve_phantom,
        validation_notes,
        write_outcome,
    )

    recording = open_phantom(images, settings)
    with s3.progress_bar(f"looking into {images.name}") as progress, naming(str(images)):
        detections = detect_phantom(recording, settings, progress)
    with naming(str(images)):
        outcome = solve_phantom(recording, detections, settings)
    notes = remarks(outcome)
    if settings.validation is not None:
        with s3.progress_bar(f"looking into {settings.validation.name}") as progress:
            notes += validation_notes(outcome, settings, progress)
    files = write_outcome(outcome, settings, images, out, notes)
    return report_of(files, notes, outcome.beam)


def repeatability(calibrations: list[Path], size_px: tuple[int, int] | None = None) -> Result:
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

    scatter = repeated([s3.load_calibration(path) for path in calibrations], size_px)
    angles_deg, shifts_mm = np.rad2deg(scatter.roll_yaw_tilt_sd_rad), scatter.centre_shift_mm
    lines = [
        f"standard deviation over {scatter.trials} calibrations",
        "  roll {:.3f}, yaw {:.3f}, tilt {:.3f} deg".format(*angles_deg),
    ]
    if shifts_mm is None:
        note("with --size-px COLUMNS ROWS also the scatter of the image's centre and corners")
    else:
        lines.append(f"  centre {scatter.centre_sd_mm:.3f} mm, corners {scatter.corner_sd_mm:.3f} mm")
        shifts = ", ".join(f"{shift:.2f}" for shift in shifts_mm)
        lines.append(f"centre against the first calibration: {shifts} mm")
    numbers = {
        "trials": scatter.trials,
        "roll_yaw_tilt_sd_deg": angles_deg,
        "centre_sd_mm": scatter.centre_sd_mm,
        "corner_sd_mm": scatter.corner_sd_mm,
        "centre_shift_mm": shifts_mm,
    }
    return numbers, "\n".join(lines)
