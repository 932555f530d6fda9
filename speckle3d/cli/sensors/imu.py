"""The orientation sensor: its logs, its orientation, its accuracy, and recording it live."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import typer

import speckle3d as s3
import xsens
from speckle3d.cli.common import (
    MaybeNumber,
    MaybePath,
    OptionalOut,
    OutArgument,
    Paths,
    Result,
    WritablePath,
    note,
    rows_of,
    status_line,
)
from speckle3d.core.errors import InvalidInputError, naming

World = Annotated[Literal["ENU", "NWU", "NED"] | None, typer.Option(case_sensitive=False)]
Method = Literal["smoother", "filter", "vqf", "vqf-online", "sensor"]


def read(path: Path, rate_hz: float | None = None, world: str | None = None) -> xsens.ImuLog:
    """Read a log of any kind, or what a recording holds of its orientation sensor."""
    from speckle3d.sensor_logs import held_log

    log = held_log(path)
    if log is None:
        return xsens.read_log(path, xsens.Hints(rate_hz=rate_hz, world=world))
    if rate_hz is not None or world is not None:
        flag = "--world" if rate_hz is None else "--rate-hz"
        raise InvalidInputError(f"{flag}: expected a log with it, got {path.name}, which says it itself")
    return log


def note_gaps(log: xsens.ImuLog) -> None:
    """Report on stderr what a log lacks, and what was assumed in its place."""
    from xsens.logs.contradictions import contradictions

    note(
        *log.notes,
        contradictions(log)[0].get("gravity"),
        log.losses and f"{log.losses}; nothing filled in",
    )


def orientation_of(
    log: xsens.ImuLog, method: Method, magnetometer: bool
) -> tuple[xsens.TimedRotations, xsens.Orientation | None]:
    """Orientation of a log, and how it was estimated; None for the sensor's own."""
    from xsens.logs.contradictions import contradictions

    readings = log.gyroscope_rad_s is not None or log.accelerometer_m_s2 is not None
    if method != "sensor" and log.oriented.any() and not readings:
        note("no gyroscope and no accelerometer: the orientation is the sensor's own")
        method = "sensor"
    if method == "sensor":
        against = contradictions(log)[0]
        if against.get("own orientation") and against.get("accelerometer") == "":
            raise InvalidInputError(
                f"{against['own orientation']} The accelerometer agrees with the gyroscope"
            )
        return log.rotations(), None

    orientation = xsens.orient(log, magnetometer, method)
    note(*orientation.notes)
    return orientation.rotations, orientation


def info(log_file: Path, rate_hz: MaybeNumber = None, world: World = None) -> Result:
    """Tell what a log holds, what is missing and what was skipped.

    Parameters
    ----------
    log_file, rate_hz, world, as_json

    Examples
    --------
    $ speckle3d imu info log.mtb
    """
    from speckle3d.core.sweep import INERTIAL
    from xsens.logs.contradictions import contradictions
    from xsens.logs.samples import median_norm

    log = read(log_file, rate_hz, world)
    rate = (f"{log.rate_hz:.2f}", "samples/s") if math.isfinite(log.rate_hz) else ("unknown", "")
    rows = [
        ("samples", str(len(log)), ""),
        ("duration", f"{log.duration_s:.3f}", "s"),
        ("rate", *rate),
        ("lost", str(log.lost), "samples"),
        ("gaps", str(len(log.gaps)), ""),
        ("longest gap", f"{max((gap.duration_s for gap in log.gaps), default=0.0):.3f}", "s"),
        ("own orientation", str(int(log.oriented.sum())), "samples"),
    ]
    for name, unit in zip(INERTIAL, ("m/s^2", "rad/s", "a.u."), strict=True):
        values, noun = getattr(log, name), name.split("_")[0]
        norm = math.nan if values is None else median_norm(values)
        rows.append((f"{noun}, median norm", f"{norm:.4f}", unit) if norm == norm else (noun, "none", ""))
    notes = [*log.notes, *filter(None, contradictions(log)[0].values())]
    return rows_of([*rows, *(("note", text, "") for text in notes)])


def convert(
    log_file: Path, out: Annotated[OutArgument, "log"], rate_hz: MaybeNumber = None, world: World = None
) -> None:
    """Turn a log of any kind into a plain CSV in SI units, on the sensor's own clock.

    Parameters
    ----------
    log_file
    out
        CSV to write; or -o OUT.
    rate_hz, world

    Examples
    --------
    $ speckle3d imu convert log.mtb log.csv
    """
    log = read(log_file, rate_hz, world)
    xsens.write_csv(out, log)
    note_gaps(log)


def orient(
    log_file: Path,
    into: MaybePath = None,
    out: Annotated[OptionalOut, "log"] = None,
    method: Method = "smoother",
    magnetometer: bool = True,
    time_offset_s: MaybeNumber = None,
    calibration: MaybePath = None,
    replace: bool = False,
    rate_hz: MaybeNumber = None,
    world: World = None,
) -> Result:
    """Find the sensor's orientation from its log, and put it into a sweep, on its own clock.

    Parameters
    ----------
    log_file
    into
        Sweep file to put the stream into.
    out
        CSV of the log with this orientation.
    method, magnetometer
    time_offset_s
        With --into: a reading at t belongs to image time t + this (0, or as LOG has it if it is a sweep); see
        `speckle3d calibrate clock`.
    calibration
        With --into: calibration file of this mounting, to go into the sweep with it.

    Other Parameters
    ----------------
    replace
        With --into: replace a stream that the sweep has.
    rate_hz, world, as_json

    Examples
    --------
    $ speckle3d imu orient log.mtb --into sweep.h5 --calibration imu.h5
    """
    import numpy as np

    from speckle3d.sensor_logs import attach_log, ridden_along, with_orientation

    if into is None and out is None:
        raise InvalidInputError("expected --into SWEEP.h5, -o CSV or both, got neither")
    if into is not None and not replace and s3.load_sweep(into).orientation is not None:
        raise InvalidInputError(
            f"{into}: expected no orientation sensor's stream, got one: --replace replaces it"
        )
    sensor = ridden_along(log_file)
    log = read(log_file, rate_hz, world)
    with naming(str(log_file)):
        rotations, orientation = orientation_of(log, method, magnetometer)
    if into is not None:
        # As options say, else the calibration, else the sweep that the log is from.
        offset_s, mounting = (sensor.time_offset_s, sensor.sensor_from_image) if sensor else (0.0, None)
        if calibration is not None:
            solution = s3.load_calibration(calibration)
            mounting = solution.rotation
            offset_s = offset_s if solution.time_offset_s is None else solution.time_offset_s
        offset_s = offset_s if time_offset_s is None else time_offset_s
        coverage = attach_log(into, log, rotations, mounting, offset_s, replace)
        note(f"orientation of {len(rotations)} samples in {into}{coverage}")
    if out is not None:
        xsens.write_csv(out, with_orientation(log, rotations))
    note_gaps(log)
    rows: list[tuple[str, float, str]] = [("samples", len(rotations), ""), ("duration", log.duration_s, "s")]
    if orientation is not None:
        sigma = np.rad2deg(orientation.standard_deviation_rad)
        inclination = np.linalg.norm(sigma[:, :2], axis=1) / np.sqrt(2.0)
        heading = "heading" if orientation.magnetic else "heading relative to the start"
        for name, values in (("inclination", inclination), (heading, sigma[:, 2])):
            rows.append((f"{name}, standard deviation, median", float(np.median(values)), "deg"))
        if orientation.magnetic:
            disturbed = 100.0 * float(np.mean(orientation.disturbed))
            rows.append(("magnetic field disturbed", disturbed, "% of samples"))
    name = "sensor" if orientation is None else method
    lines = [("method", name, ""), *((key, f"{value:.5g}", unit) for key, value, unit in rows)]
    return {"method": name} | {key: value for key, value, _ in rows}, rows_of(lines)[1]


def accuracy(
    log_file: Path,
    reference: MaybePath = None,
    optical: MaybePath = None,
    calibration: Paths = None,
    turns: str = "roll, yaw, tilt",
    fit_mounting: bool = True,
    time_offset_s: float = 0.0,
    method: Method = "smoother",
    magnetometer: bool = True,
    figure: Annotated[WritablePath, "picture"] = None,
    rate_hz: MaybeNumber = None,
    world: World = None,
) -> Result:
    """Compare the angles between all pairs of orientations with a reference's (Housden 2008, Table 2).

    One of --reference or --optical.

    Parameters
    ----------
    log_file
    reference
        Settings of a mechanism: CSV with tilt, yaw, roll in degrees, perhaps time_s and until_s.
    optical
        Orientation by a tracker: TUM text, or a log that carries its own orientation.
    calibration
        Calibration files; may be repeated.
    method
    figure
        PNG of single turns, as Figure 5 of the paper.
    as_json

    Other Parameters
    ----------------
    turns
        With --reference: the mechanism's axes from its base to the probe.
    fit_mounting
        With --optical: the target's axes on the probe: found from the motion, or those of the image.
    time_offset_s
        With --optical: a reading of the sensor at t belongs to the tracker's time t + this.
    magnetometer, rate_hz, world

    Examples
    --------
    $ speckle3d imu accuracy log.mtb --optical tracker.tum --calibration imu.h5
    """
    import numpy as np
    from scipy.spatial.transform import Rotation

    from speckle3d.core.text import text_table
    from speckle3d.study.figures import save_figure
    from xsens.accuracy.angles import ANGLES

    log = read(log_file, rate_hz, world)
    note_gaps(log)
    mountings = Rotation.identity(1)
    if calibration:
        mountings = Rotation.concatenate([s3.load_calibration(path).rotation for path in calibration])
    else:
        note("no --calibration: the sensor's axes are taken for the image's")
    mechanism = None if reference is None else xsens.read_mechanism_csv(reference, turns)
    with naming(str(log_file)):
        rotations, _ = orientation_of(log, method, magnetometer)
        if mechanism is not None:
            readings, truth = xsens.readings_at(rotations, mechanism), mechanism.base_from_image
        elif optical is not None:
            readings, truth = xsens.common_readings(rotations, _optical(optical), time_offset_s)
            if fit_mounting:
                note("the target's mounting is found from the motion: constant errors do not show")
                truth = truth * xsens.mounting_from_motion(readings * mountings.mean(), truth)
        errors = xsens.pair_errors(readings, truth, mountings)
    if figure is not None:
        save_figure(xsens.figure_turns(errors, log_file.name), figure)
    statistics_deg = {name: np.rad2deg(values) for name, values in errors.statistics().items()}
    rows = [
        (f"{log_file.stem}: {angle} error, {statistic}", float(value), "degrees")
        for statistic, values in statistics_deg.items()
        for angle, value in zip(ANGLES, values, strict=True)
    ]
    mean, deviation, *_ = statistics_deg.values()
    cells = (f"{error:+.4f} ± {sd:.4f}" for error, sd in zip(mean, deviation, strict=True))
    table = text_table([["degrees", *map(str.capitalize, ANGLES)], [log_file.stem, *cells]])
    how = f"{len(errors)} errors: pairs of {errors.frames} orientations, {len(mountings)} calibrations"
    return rows_of(rows)[0], table + how


def _optical(path: Path) -> xsens.TimedRotations:
    """Orientation by a tracker, of TUM text or of a log that carries its own."""
    from speckle3d.io.tum import is_tum, read_tum

    if is_tum(path):
        poses = read_tum(path)
        return xsens.TimedRotations(poses.time_s, poses.world_from_sensor.rotation)
    log = read(path)
    note_gaps(log)
    return log.rotations()


def record(
    port: str,
    out: OutArgument,
    content: str = "orientation",
    rate_hz: MaybeNumber = None,
    baud: int | None = None,
    duration_s: MaybeNumber = None,
    append: bool = False,
) -> None:
    """Record a sensor on a serial port; every byte is in the file as soon as it has come.

    Parameters
    ----------
    port
        Serial port of the sensor, as /dev/ttyUSB0 or COM3.
    out
        File for the sensor's bytes; or -o OUT.
    content
        orientation, calibrated, raw, or `as set`.
    rate_hz
        Samples per second; by default as set.
    duration_s
        Stop after so long; by default at Ctrl-C.

    Other Parameters
    ----------------
    baud
        Of the line; by default the common ones are tried.
    append
        Go on in a file that is there.

    Examples
    --------
    $ speckle3d imu record /dev/ttyUSB0 log.mtb
    """
    state, settings = None, xsens.DeviceSettings(content, rate_hz, baud)
    duration_s = math.inf if duration_s is None else duration_s
    try:
        with status_line() as show:
            show("connecting")
            for state in xsens.record(port, out, settings, append, duration_s=duration_s):
                show(_line(state))
    except KeyboardInterrupt:
        note("stopped")
    if state is not None:
        note(
            f"{state.samples} samples, {state.lost} lost, {state.interruptions} interruptions; bytes in {out}"
        )


def _line(state: xsens.LiveState) -> str:
    parts = [f"{state.elapsed_s:6.1f} s", f"{state.samples} samples", f"{state.lost} lost"]
    parts.append(f"{state.rate_hz:.1f} Hz" if state.connected else "NOT CONNECTED")
    if state.interruptions:
        parts.append(f"{state.interruptions} interruptions")
    if state.world_from_sensor is not None:
        yaw, pitch, roll = state.world_from_sensor.as_euler("ZYX", degrees=True)
        parts.append(f"roll {roll:+.1f} pitch {pitch:+.1f} yaw {yaw:+.1f}")
    if math.isfinite(state.field):
        verdict = {None: "", True: " DISTURBED", False: " clear"}[state.disturbed]
        parts.append(f"field {state.field:.2f} dip {math.degrees(state.dip_rad):.0f}{verdict}")
    if state.note and not state.connected:
        parts.append(state.note)
    return " | ".join(parts)
