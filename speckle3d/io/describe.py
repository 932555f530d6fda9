"""What a file holds, told in rows of description, value and unit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.calibration import Calibration, Parameter, readable
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.geometry import elevational_steps, roll_yaw_tilt
from speckle3d.core.labels import LabelMap
from speckle3d.core.printable import printable
from speckle3d.core.reconstruction import ImportRecord
from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep, stored_dtype
from speckle3d.io import calibrations, curves, reconstructions
from speckle3d.io.calibrations import read_calibration
from speckle3d.io.hdf5 import (
    PathLike,
    find_member,
    open_hdf5,
    plain_attribute,
    reading,
    require_dataset,
    require_group,
)
from speckle3d.io.load import kind_of, open_recording
from speckle3d.io.readers import Row
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.io.voxels.volumes import is_volume, read_volume

_UNIT_NAMES = {"mm": "mm", "hz": "Hz", "db": "dB", "m_s": "m/s"}


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
    kind = kind_of(path)
    rows: list[Row] = [("format", kind, "")]
    if kind in _DESCRIBERS:
        return [*rows, *_DESCRIBERS[kind](path)]
    recording = open_recording(path)
    rows += recording.describe()
    try:
        return [*rows, *sweep_rows(recording.sweep)]
    except (InvalidInputError, FileError) as error:
        if len(rows) == 1:
            raise
        return [*rows, ("sweep", f"none: {error}", "")]


def sweep_rows(sweep: Sweep) -> list[Row]:
    """Tell what a sweep holds."""
    grid = sweep.grid
    return [
        ("frames", str(len(sweep)), ""),
        *_rate_rows("", sweep.frame_time_s, "frames/s"),
        ("vectors x samples", f"{grid.vectors} x {grid.samples}", ""),
        ("sample type", _sample_type(sweep), ""),
        ("vector pitch", f"{grid.vector_pitch_mm:.4g}", "mm"),
        ("sample spacing", f"{grid.sample_spacing_mm:.4g}", "mm"),
        ("width", f"{grid.width_mm:.2f}", "mm"),
        ("depth", f"{grid.first_sample_depth_mm:.2f} to {grid.depth_mm:.2f}", "mm"),
        *_signal_rows(sweep.signal),
        *_sensor_rows(sweep),
    ]


def _rate_rows(name: str, times: FloatArray, unit: str) -> list[Row]:
    span = float(times[-1] - times[0])
    rows = [(f"{name} duration".strip(), f"{span:.3f}", "s")]
    if times.size > 1:
        rows.append((f"{name} rate".strip(), f"{(times.size - 1) / span:.2f}", unit))
    return rows


def _signal_rows(signal: RFSettings | BModeSettings) -> list[Row]:
    if not isinstance(signal, RFSettings):
        return [("signal", "B-mode", ""), ("dynamic range", f"{signal.dynamic_range_db:g}", "dB")]
    low, high = (f"{edge / 1e6:g}" for edge in signal.bandwidth_hz)
    return [
        *_kind_rows(signal.demodulation_frequency_hz),
        ("sampling rate", f"{signal.sampling_rate_hz / 1e6:g}", "MHz"),
        ("centre frequency", f"{signal.centre_frequency_hz / 1e6:g}", "MHz"),
        ("band", f"{low} to {high}", "MHz"),
        ("speed of sound", f"{signal.speed_of_sound_m_s:g}", "m/s"),
    ]


def _kind_rows(demodulation_frequency_hz: float | None) -> list[Row]:
    if demodulation_frequency_hz is None:
        return [("signal", "RF", "")]
    if demodulation_frequency_hz == 0:
        return [("signal", "I/Q, not demodulated (the analytic signal)", "")]
    return [
        ("signal", "I/Q", ""),
        ("demodulation frequency", f"{demodulation_frequency_hz / 1e6:g}", "MHz"),
    ]


def _sample_type(sweep: Sweep) -> str:
    stored = stored_dtype(sweep.frames)
    if sweep.frames.dtype == stored:
        return str(stored)
    return f"{sweep.frames.dtype}, stored as pairs of {stored}"


def _sensor_rows(sweep: Sweep) -> list[Row]:
    rows: list[Row] = []
    for name, sensor in (("orientation sensor", sweep.orientation), ("tracker", sweep.tracker)):
        if sensor is None:
            rows.append((name, "none", ""))
            continue
        covered = int(np.count_nonzero(sensor.covers(sweep.frame_time_s)))
        rows += [
            (name, str(len(sensor.readings)), "samples"),
            *_rate_rows(name, sensor.readings.time_s, "samples/s"),
            (f"{name} covers", str(covered), "frames"),
            (f"{name} calibrated", "no" if sensor.sensor_from_image is None else "yes", ""),
            (f"{name} time offset", f"{sensor.time_offset_s:g}", "s"),
        ]
    if sweep.tracker is not None and sweep.tracker.image_skew_rad:
        rows.append(("image axes off square", f"{np.rad2deg(sweep.tracker.image_skew_rad):.3g}", "deg"))
    return [*rows, ("truth", "no" if sweep.truth is None else "yes", "")]


def _describe_reconstruction(path: PathLike) -> list[Row]:
    result = read_reconstruction(path)
    rows = [("frames", str(result.frame_time_s.size), "")]
    rows += _rate_rows("", result.frame_time_s, "frames/s") if result.frame_time_s.size else []
    for mode, poses in result.poses.items() if result.frame_time_s.size else ():
        length_mm = abs(elevational_steps(poses, result.grid.centre_mm).sum())
        rows.append((f"length, mode {mode}", f"{length_mm:.2f}", "mm"))
    pairs = result.pairs
    return [
        *rows,
        ("frame pairs", str(0 if pairs is None else len(pairs)), ""),
        ("patches", str(0 if pairs is None else len(pairs.patch_centre_mm)), ""),
        ("input", result.provenance.input_path, ""),
        ("input SHA-256", result.provenance.input_sha256, ""),
        ("package version", result.provenance.package_version, ""),
        *((f"calibration of {one.sensor}", one.path, "") for one in result.provenance.calibrations),
        *_import_rows(result.provenance.imported),
    ]


def _import_rows(imported: ImportRecord | None) -> list[Row]:
    if imported is None:
        return []
    return [("import settings of", imported.name, ""), ("import settings", imported.settings_json, "")]


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
        ("input", held.source.input_path, ""),
        ("input SHA-256", held.source.input_sha256, ""),
        ("package version", held.source.package_version, ""),
    ]


def _mounting_rows(held: Calibration) -> list[Row]:
    """Where the image is, angles in degrees, and how well that is known about and along the image's axes."""
    angles = zip(("roll", "yaw", "tilt"), np.rad2deg(roll_yaw_tilt(held.rotation)), strict=True)
    spread = np.sqrt(np.diag(held.covariance))
    rows: list[Row] = [(f"sensor_from_image {name}", f"{angle:.3f}", "deg") for name, angle in angles]
    rows.append(("standard error, tilt, yaw, roll", _listed(np.rad2deg(spread[:3])), "deg"))
    if held.translation_mm is not None:
        rows.insert(3, ("sensor_from_image x, y, z", _listed(held.translation_mm), "mm"))
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
        *(
            (f"direction of {axis} (LPS)", _listed(along), "")
            for axis, along in zip("ijk", turned, strict=True)
        ),
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
    """Attributes, but for the format, and lengths of data sets as they are."""
    rows: list[Row] = []
    curves.read_curves(path)
    with reading(path), open_hdf5(path) as file:
        for name in file.attrs:
            if name != "format":
                spoken, unit = _spoken(name)
                rows.append((spoken, str(plain_attribute(file, name)), unit))
        names = {name for name in file if isinstance(name, str)}
        groups = {name for name in names if isinstance(find_member(file, name), h5py.Group)}
        below = {f"{name}/{inner}" for name in groups for inner in require_group(file, name)}
        for name in sorted((names | below) - groups):
            shape = " x ".join(str(n) for n in require_dataset(file, name).shape)
            rows.append((_spoken(name)[0], shape, "values"))
    return rows


def _spoken(name: str) -> tuple[str, str]:
    """Name in words, and unit, of an attribute or data set."""
    found = next((unit for unit in _UNIT_NAMES if name.endswith(f"_{unit}")), None)
    words = name.removesuffix(f"_{found}").replace("_", " ").replace("/", ", ")
    return words, "" if found is None else _UNIT_NAMES[found]


_DESCRIBERS: dict[str, Callable[[PathLike], list[Row]]] = {
    reconstructions.FORMAT: _describe_reconstruction,
    curves.FORMAT: _describe_curves,
    calibrations.FORMAT: _describe_calibration,
}
