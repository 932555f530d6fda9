"""Describe a file in rows of description, value and unit."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import Speckle3DError
from speckle3d.core.files import PathLike
from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep
from speckle3d.core.volume import LabelMap
from speckle3d.io.family import calibrations, curves, reconstructions
from speckle3d.io.load import kind_of, open_recording
from speckle3d.io.recordings import Row, number_row, rate_of
from speckle3d.io.voxels.volumes import is_volume, read_volume


def describe(path: PathLike) -> list[Row]:
    """Describe a file as rows of description, value and unit.

    Of a recording, rows tell what its reader found, also where there is no sweep in it, and why.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it is of no known kind, or what it holds is not valid.
    """
    return list(_rows(path))


def _rows(path: PathLike) -> Iterator[Row]:
    if is_volume(path):
        yield "format", "volume", ""
        yield from _volume_rows(path)
        return
    kind = kind_of(path)
    yield "format", kind, ""
    if kind in _TELL:
        yield from _TELL[kind](path)
        return
    recording = open_recording(path)
    facts = recording.describe()
    yield from facts
    try:
        sweep = recording.sweep
    except Speckle3DError as error:
        if not facts:
            raise
        yield "sweep", f"none: {error}", ""
    else:
        yield from _sweep_rows(sweep)


def _sweep_rows(sweep: Sweep) -> Iterator[Row]:
    grid = sweep.grid
    yield "frames", str(len(sweep)), ""
    yield from _rate_rows("", sweep.frame_time_s, "frames/s")
    yield "vectors x samples", f"{grid.vectors} x {grid.samples}", ""
    yield "sample type", str(sweep.frames.dtype), ""
    yield "vector pitch", f"{grid.vector_pitch_mm:.4g}", "mm"
    yield "sample spacing", f"{grid.sample_spacing_mm:.4g}", "mm"
    yield "width", f"{grid.width_mm:.2f}", "mm"
    yield "depth", f"{grid.first_sample_depth_mm:.2f} to {grid.depth_mm:.2f}", "mm"
    if grid.fan is not None:
        yield number_row("array_radius_mm", grid.fan.radius_mm)
        yield number_row("line_angles_deg", np.rad2deg(grid.angle_rad([0, grid.vectors - 1])))
    yield from _signal_rows(sweep.signal)
    for name, sensor in (("orientation sensor", sweep.orientation), ("tracker", sweep.tracker)):
        if sensor is None:
            yield name, "none", ""
            continue
        yield name, str(len(sensor.readings)), "samples"
        yield from _rate_rows(f"{name} ", sensor.readings.time_s, "samples/s")
        yield f"{name} covers", str(np.count_nonzero(sensor.covers(sweep.frame_time_s))), "frames"
        yield f"{name} calibrated", "no" if sensor.sensor_from_image is None else "yes", ""
        yield f"{name} time offset", f"{sensor.time_offset_s:g}", "s"
    if sweep.tracker is not None and sweep.tracker.image_skew_rad:
        yield "image axes off square", f"{np.rad2deg(sweep.tracker.image_skew_rad):.3g}", "deg"
    yield "truth", "no" if sweep.truth is None else "yes", ""


def _signal_rows(signal: RFSettings | BModeSettings) -> Iterator[Row]:
    kind = "B-mode"
    if isinstance(signal, RFSettings):
        carries = not signal.demodulation_frequency_hz
        kind = "RF" if not signal.are_complex else "I/Q, the analytic signal" if carries else "I/Q"
    yield "signal", kind, ""
    for name, value in vars(signal).items():
        if value and name != "full_scale":
            yield number_row(name, value)


def _rate_rows(name: str, times: FloatArray, unit: str) -> Iterator[Row]:
    rate = rate_of(times)
    yield f"{name}duration", f"{(times.size - 1) / rate if rate else 0.0:.3f}", "s"
    yield f"{name}rate", f"{rate:.2f}" if rate else "", unit


def _reconstruction_rows(path: PathLike) -> Iterator[Row]:
    result = reconstructions.read_reconstruction(path)
    pairs, times = result.pairs, result.frame_time_s
    yield "frames", str(times.size), ""
    yield from _rate_rows("", times, "frames/s")
    yield "frame pairs", str(len(pairs) if pairs else 0), ""
    yield "patches", str(len(pairs.patch_centre_mm) if pairs else 0), ""
    yield from _source_rows(result.provenance)
    for calibration in result.provenance.calibrations:
        yield f"calibration of {calibration.sensor}", calibration.path, ""
    if (settings := result.provenance.imported) is not None:
        yield f"import settings of {settings.name}", settings.settings_json, ""
    if times.size:
        from speckle3d.scoring.lengths import part_lengths

        for mode, mm in part_lengths(result.poses, result.grid.centre_mm)[1].items():
            yield f"length, mode {mode}", f"{mm.sum():.2f}", "mm"


def _source_rows(source: Any) -> Iterator[Row]:
    yield "input", source.input_path, ""
    yield "input SHA-256", source.input_sha256, ""
    yield "package version", source.package_version, ""


def _calibration_rows(path: PathLike) -> Iterator[Row]:
    calibration = calibrations.read_calibration(path)
    yield from calibration.rows()
    yield from _source_rows(calibration.source)


def _list_text(values: FloatArray) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def _volume_rows(path: PathLike) -> Iterator[Row]:
    volume = read_volume(path)
    yield "voxels", " x ".join(map(str, volume.shape)), ""
    yield "spacing", " x ".join(f"{step:g}" for step in volume.spacing_mm), "mm"
    yield "voxel type", volume.voxels.dtype.name, ""
    yield "first voxel at x, y, z (LPS)", _list_text(volume.world_from_grid.translation), "mm"
    for axis, direction in zip("ijk", volume.world_from_grid.rotation.as_matrix().T, strict=True):
        yield f"direction of {axis} (LPS)", _list_text(direction), ""
    for name, text in volume.fields.items():
        yield name, text, ""
    if isinstance(volume, LabelMap):
        for segment in volume.segments:
            count = np.count_nonzero(volume.voxels == segment.value)
            yield f"label {segment.value}", f"{segment.name}: {count}", "voxels"
    else:
        levels = volume.voxels[np.isfinite(volume.voxels)]
        yield "levels found", f"{levels.min():g} to {levels.max():g}" if levels.size else "none", ""


def _curves_rows(path: PathLike) -> Iterator[Row]:
    record = curves.read_curves(path)
    half = [np.interp(-0.5, -row, record.distance_mm) for row in record.correlation]
    yield "probe", record.key.probe or "not named", ""
    yield "origin", record.origin, ""
    yield from _signal_rows(record.key.signal)
    yield number_row("vector_pitch_mm", record.key.vector_pitch_mm)
    yield "patches", f"{record.key.patch_width_mm:g} x {record.key.patch_height_mm:g}", "mm"
    yield "correlation of", record.key.correlation_of, ""
    yield "depths", f"{record.depth_mm.size}, {record.depth_mm[0]:.1f} to {record.depth_mm[-1]:.1f}", "mm"
    yield "distances", f"up to {record.distance_mm[-1]:.2f}", "mm"
    yield "correlation halves at", f"{min(half):.2f} to {max(half):.2f}", "mm"
    yield "frame pairs", str(record.pairs_used), ""
    yield "lengths read with them, 95 %", f"+- {196 * record.scale_sigma:.1f}", "%"


_TELL: dict[str, Callable[[PathLike], Iterator[Row]]] = {
    reconstructions.FORMAT: _reconstruction_rows,
    curves.FORMAT: _curves_rows,
    calibrations.FORMAT: _calibration_rows,
}
