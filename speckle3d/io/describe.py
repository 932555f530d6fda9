"""What a file holds, told in rows of description, value and unit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.geometry import elevational_steps
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
        if (tell := _DESCRIBERS.get(kind := family_format(path))) is None:
            raise InvalidInputError(f"{path}: expected {' or '.join(_DESCRIBERS)}, got {kind}")
        return [("format", kind, ""), *tell(path)]
    recording = recording_of(reader, Path(path), settings_for(path))
    rows = [("format", reader.format, ""), *recording.describe()]
    try:
        return [*rows, *_sweep_rows(recording.sweep)]
    except (InvalidInputError, FileError) as error:
        if len(rows) == 1:
            raise
        return [*rows, ("sweep", f"none: {error}", "")]


def _sweep_rows(sweep: Sweep) -> list[Row]:
    grid, stored = sweep.grid, stored_dtype(sweep.frames)
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
        angles_deg = np.rad2deg(grid.angle_rad([0, grid.vectors - 1]))
        rows.append(number_row("array_radius_mm", grid.fan.radius_mm))
        rows.append(number_row("line_angles_deg", angles_deg))
    rows += _signal_rows(sweep.signal)
    sensors = {"orientation sensor": sweep.orientation, "tracker": sweep.tracker}
    for name, sensor in sensors.items():
        if sensor is None:
            rows.append((name, "none", ""))
            continue
        rows += [
            (name, str(len(sensor.readings)), "samples"),
            *_rate_rows(f"{name} ", sensor.readings.time_s, "samples/s"),
            (f"{name} covers", str(np.count_nonzero(sensor.covers(sweep.frame_time_s))), "frames"),
            (f"{name} calibrated", "no" if sensor.sensor_from_image is None else "yes", ""),
            (f"{name} time offset", f"{sensor.time_offset_s:g}", "s"),
        ]
    if sweep.tracker is not None and sweep.tracker.image_skew_rad:
        rows.append(("image axes off square", f"{np.rad2deg(sweep.tracker.image_skew_rad):.3g}", "deg"))
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
    pairs, times = result.pairs, result.frame_time_s
    rows = [("frames", str(times.size), ""), *_rate_rows("", times, "frames/s")]
    for mode, poses in result.poses.items() if times.size else ():
        length_mm = abs(elevational_steps(poses, result.grid.centre_mm).sum())
        rows.append((f"length, mode {mode}", f"{length_mm:.2f}", "mm"))
    rows += [
        ("frame pairs", str(0 if pairs is None else len(pairs)), ""),
        ("patches", str(0 if pairs is None else len(pairs.patch_centre_mm)), ""),
        *_source_rows(result.provenance),
        *((f"calibration of {one.sensor}", one.path, "") for one in result.provenance.calibrations),
    ]
    if (imported := result.provenance.imported) is not None:
        rows.append((f"import settings of {imported.name}", imported.settings_json, ""))
    return rows


def _source_rows(source: Any) -> list[Row]:
    names = {"input_path": "input", "input_sha256": "input SHA-256", "package_version": "package version"}
    return [(words, getattr(source, name), "") for name, words in names.items()]


def _describe_calibration(path: PathLike) -> list[Row]:
    calibration = read_calibration(path)
    return [*calibration.rows(), *_source_rows(calibration.source)]


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
        levels = volume.voxels[np.isfinite(volume.voxels)]
        extent = f"{levels.min():g} to {levels.max():g}" if levels.size else "none"
        return [*rows, ("levels found", extent, "")]
    counts = {one: np.count_nonzero(volume.voxels == one.value) for one in volume.segments}
    return rows + [(f"label {one.value}", f"{one.name}: {n}", "voxels") for one, n in counts.items()]


def _describe_curves(path: PathLike) -> list[Row]:
    held = curves.read_curves(path)
    half = [np.interp(-0.5, -row, held.distance_mm) for row in held.correlation]
    return [
        ("probe", held.key.probe or "not named", ""),
        ("origin", held.origin, ""),
        *_signal_rows(held.key.signal),
        number_row("vector_pitch_mm", held.key.vector_pitch_mm),
        ("patches", f"{held.key.patch_width_mm:g} x {held.key.patch_height_mm:g}", "mm"),
        ("correlation of", held.key.correlation_of, ""),
        ("depths", f"{held.depth_mm.size}, {held.depth_mm[0]:.1f} to {held.depth_mm[-1]:.1f}", "mm"),
        ("distances", f"up to {held.distance_mm[-1]:.2f}", "mm"),
        ("correlation halves at", f"{min(half):.2f} to {max(half):.2f}", "mm"),
        ("frame pairs", str(held.pairs_used), ""),
        ("lengths read with them, 95 %", f"+- {196 * held.scale_sigma:.1f}", "%"),
    ]


_DESCRIBERS: dict[str, Callable[[PathLike], list[Row]]] = {
    reconstructions.FORMAT: _describe_reconstruction,
    curves.FORMAT: _describe_curves,
    calibrations.FORMAT: _describe_calibration,
}
