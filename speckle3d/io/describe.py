"""What a file holds, told in rows of description, value and unit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.calibration import Calibration, Parameter, readable
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.geometry import elevational_steps, roll_yaw_tilt
from speckle3d.core.labels import LabelMap
from speckle3d.core.printable import printable
from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep, stored_dtype
from speckle3d.io import calibrations, curves, reconstructions
from speckle3d.io.calibrations import read_calibration
from speckle3d.io.import_settings import settings_for
from speckle3d.io.load import family_format, recording_of
from speckle3d.io.readers import find_reader
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.io.recordings import Row, number_row
from speckle3d.io.voxels.volumes import is_volume, read_volume


def describe(path: PathLike) -> list[Row]:
    """Tell what a file holds as rows of description, value and unit.

    Of a recording, rows tell what its reader found, also where there is no sweep in it, and why.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it is of no known kind, or what it holds is not valid.
    """
    if Path(path).is_file() and is_volume(path):
        return [("format", "volume", ""), *_describe_volume(path)]
    if (reader := find_reader(path)) is None:
        kind = family_format(path)
        if kind not in _DESCRIBERS:
            raise InvalidInputError(f"{path}: expected {' or '.join(_DESCRIBERS)}, got {kind}")
        return [("format", kind, ""), *_DESCRIBERS[kind](path)]
    recording = recording_of(reader, Path(path), settings_for(path))
    rows = [("format", reader.format, ""), *recording.describe()]
    try:
        return [*rows, *sweep_rows(recording.sweep)]
    except (InvalidInputError, FileError) as error:
        if len(rows) == 1:
            raise
        return [*rows, ("sweep", f"none: {error}", "")]


def sweep_rows(sweep: Sweep) -> list[Row]:
    """Tell what a sweep holds."""
    grid, stored, tracker = sweep.grid, stored_dtype(sweep.frames), sweep.tracker
    narrow = "" if sweep.frames.dtype == stored else f", stored as pairs of {stored}"
    rows = [
        ("frames", str(len(sweep)), ""),
        *_rate_rows("", sweep.frame_time_s, "frames/s"),
        ("vectors x samples", f"{grid.vectors} x {grid.samples}", ""),
        ("sample type", f"{sweep.frames.dtype}{narrow}", ""),
        ("vector pitch", f"{grid.vector_pitch_mm:.4g}", "mm"),
        ("sample spacing", f"{grid.sample_spacing_mm:.4g}", "mm"),
        ("width", f"{grid.width_mm:.2f}", "mm"),
        ("depth", f"{grid.first_sample_depth_mm:.2f} to {grid.depth_mm:.2f}", "mm"),
    ]
    if grid.fan is not None:
        first, last = np.rad2deg(grid.angle_rad([0, grid.vectors - 1]))
        rows.append(("array radius", f"{grid.fan.radius_mm:.4g}", "mm"))
        rows.append(("vectors from straight down", f"{first:.4g} to {last:.4g}", "deg"))
    rows += _signal_rows(sweep.signal)
    for name, sensor in (("orientation sensor", sweep.orientation), ("tracker", tracker)):
        if sensor is None:
            rows.append((name, "none", ""))
            continue
        covered = np.count_nonzero(sensor.covers(sweep.frame_time_s))
        rows += [
            (name, str(len(sensor.readings)), "samples"),
            *_rate_rows(f"{name} ", sensor.readings.time_s, "samples/s"),
            (f"{name} covers", str(covered), "frames"),
            (f"{name} calibrated", "no" if sensor.sensor_from_image is None else "yes", ""),
            (f"{name} time offset", f"{sensor.time_offset_s:g}", "s"),
        ]
    if tracker is not None and tracker.image_skew_rad:
        rows.append(("image axes off square", f"{np.rad2deg(tracker.image_skew_rad):.3g}", "deg"))
    return [*rows, ("truth", "no" if sweep.truth is None else "yes", "")]


def _signal_rows(signal: RFSettings | BModeSettings) -> list[Row]:
    kind = "B-mode"
    if isinstance(signal, RFSettings):
        is_shifted = bool(signal.demodulation_frequency_hz)
        kind = "RF" if not signal.are_complex else "I/Q" if is_shifted else "I/Q, the analytic signal"
    numbers = ((name, value) for name, value in vars(signal).items() if value and name != "full_scale")
    return [("signal", kind, ""), *(number_row(*one) for one in numbers)]


def _rate_rows(name: str, times: FloatArray, unit: str) -> list[Row]:
    span = float(np.ptp(times)) if times.size else 0.0
    rate = f"{(times.size - 1) / span:.2f}" if span else ""
    return [(f"{name}duration", f"{span:.3f}", "s"), (f"{name}rate", rate, unit)]


def _describe_reconstruction(path: PathLike) -> list[Row]:
    result = read_reconstruction(path)
    made, pairs, times = result.provenance, result.pairs, result.frame_time_s
    rows = [("frames", str(times.size), ""), *_rate_rows("", times, "frames/s")]
    for mode, poses in result.poses.items() if times.size else ():
        length_mm = abs(elevational_steps(poses, result.grid.centre_mm).sum())
        rows.append((f"length, mode {mode}", f"{length_mm:.2f}", "mm"))
    rows += [
        ("frame pairs", str(0 if pairs is None else len(pairs)), ""),
        ("patches", str(0 if pairs is None else len(pairs.patch_centre_mm)), ""),
        *_source_rows(made),
        *((f"calibration of {one.sensor}", one.path, "") for one in made.calibrations),
    ]
    if made.imported is not None:
        rows.append((f"import settings of {made.imported.name}", made.imported.settings_json, ""))
    return rows


def _source_rows(source: Any) -> list[Row]:
    names = {"input_path": "input", "input_sha256": "input SHA-256", "package_version": "package version"}
    return [(words, getattr(source, name), "") for name, words in names.items()]


def _describe_calibration(path: PathLike) -> list[Row]:
    held = read_calibration(path)
    offset = "unknown" if held.time_offset_s is None else f"{held.time_offset_s:+.4f}"
    return [
        ("method", held.method, ""),
        ("sensor", held.sensor, ""),
        *_mounting_rows(held),
        *((f"parameter {name}", value, unit) for name, value, unit in map(Parameter.row, held.parameters)),
        ("RMS residual", *readable(held.rms, held.rms_unit)),
        ("condition number", f"{held.condition_number:.1f}", ""),
        ("time offset", offset, "" if held.time_offset_s is None else "s"),
        ("frames used", f"{len(held.frames.used)} of {held.frames.given}", ""),
        *((f"dropped: {reason}", str(n), "frames") for reason, n in held.frames.reasons().items()),
        ("verdict", held.verdict, ""),
        *_source_rows(held.source),
    ]


def _mounting_rows(held: Calibration) -> list[Row]:
    """Where the image is, angles in degrees, and how well that is known about and along the image's axes."""
    spread = np.sqrt(np.diag(held.covariance))
    angles = np.rad2deg(roll_yaw_tilt(held.rotation))
    rows: list[Row] = [
        ("sensor_from_image roll, yaw, tilt", _listed(angles), "deg"),
        ("standard error, tilt, yaw, roll", _listed(np.rad2deg(spread[:3])), "deg"),
    ]
    if held.translation_mm is not None:
        rows.append(("sensor_from_image x, y, z", _listed(held.translation_mm), "mm"))
        rows.append(("standard error along the image's x, y, z", _listed(spread[3:]), "mm"))
    if held.pixel_mm is not None:
        rows.append(("pixel", " x ".join(f"{size:.5f}" for size in held.pixel_mm), "mm"))
    return rows


def _listed(values: FloatArray) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def _describe_volume(path: PathLike) -> list[Row]:
    volume = read_volume(path)
    turned = volume.world_from_grid.rotation.as_matrix().T
    rows = [
        ("voxels", " x ".join(map(str, volume.shape)), ""),
        ("spacing", " x ".join(f"{step:g}" for step in volume.spacing_mm), "mm"),
        ("voxel type", volume.voxels.dtype.name, ""),
        ("first voxel at x, y, z (LPS)", _listed(volume.world_from_grid.translation), "mm"),
        *((f"direction of {axis} (LPS)", _listed(turned[k]), "") for k, axis in enumerate("ijk")),
        *((printable(name), text, "") for name, text in volume.fields.items()),
    ]
    if not isinstance(volume, LabelMap):
        held = volume.voxels[np.isfinite(volume.voxels)]
        told = f"{held.min():g} to {held.max():g}" if held.size else "none"
        return [*rows, ("levels found", told, "")]
    for segment in volume.segments:
        count = np.count_nonzero(volume.voxels == segment.value)
        rows.append((f"label {segment.value}", f"{segment.name}: {count}", "voxels"))
    return rows


def _describe_curves(path: PathLike) -> list[Row]:
    held = curves.read_curves(path)
    key, parts = held.key, ("tilt", "speckle", "spectrum")
    half = [np.interp(-0.5, -row, held.distance_mm) for row in held.correlation]
    return [
        ("probe", key.probe or "not named", ""),
        ("origin", held.origin, ""),
        *_signal_rows(key.signal),
        ("vector pitch", f"{key.vector_pitch_mm:.4g}", "mm"),
        ("patches", f"{key.patch_width_mm:g} x {key.patch_height_mm:g}", "mm"),
        ("correlation of", key.correlation_of, ""),
        ("depths", f"{held.depth_mm.size}, {held.depth_mm[0]:.1f} to {held.depth_mm[-1]:.1f}", "mm"),
        ("distances", f"up to {held.distance_mm[-1]:.2f}", "mm"),
        ("correlation halves at", f"{min(half):.2f} to {max(half):.2f}", "mm"),
        ("frame pairs", str(held.pairs_used), ""),
        *((part, "no" if getattr(held, part) is None else "yes", "") for part in parts),
        ("lengths read with them, 95 %", f"+- {196 * held.scale_sigma:.1f}", "%"),
    ]


_DESCRIBERS: dict[str, Callable[[PathLike], list[Row]]] = {
    reconstructions.FORMAT: _describe_reconstruction,
    curves.FORMAT: _describe_curves,
    calibrations.FORMAT: _describe_calibration,
}
