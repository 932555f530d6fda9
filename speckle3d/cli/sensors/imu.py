"""The orientation sensor: its logs, its orientation, its accuracy, and recording it live."""

from __future__ import annotations

import math
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.common import Json, app, emit_json, emit_rows, note
from speckle3d.cli.helping import App
from speckle3d.cli.outputs import require_own_place
from speckle3d.cli.sensors.imu_logs import Log, RateHz, WorldOption, read, tell
from speckle3d.core.errors import InvalidInputError, naming
from xsens.fusion.methods import DEFAULT_METHOD, Method

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

    from speckle3d.core.streams import TimedRotations
    from speckle3d.core.sweep import OrientationSensor
    from xsens.fusion.orient import Orientation
    from xsens.logs.samples import ImuLog

imu = App(help="The orientation sensor: logs, live data, orientation.")
app.add_typer(imu, name="imu")


class Source(StrEnum):
    """Source of an orientation: the engines of `xsens.orient`, or the sensor itself."""

    smoother = Method.smoother.value
    filter = Method.filter.value
    vqf = Method.vqf.value
    vqf_online = Method.vqf_online.value
    sensor = "sensor"


DEFAULT_SOURCE = Source(DEFAULT_METHOD.value)
MethodOption = Annotated[
    Source,
    typer.Option(
        help="smoother: from all of the log; filter: as it would be live; vqf, vqf-online: the same by VQF "
        "(Laidig and Seel 2023); sensor: the sensor's own."
    ),
]
Magnetometer = Annotated[
    bool, typer.Option("--magnetometer/--no-magnetometer", help="Let the magnetic field tell the heading.")
]


@imu.command("info")
def imu_info(log_file: Log, rate_hz: RateHz = None, world: WorldOption = None, as_json: Json = False) -> None:
    """Tell what a log holds, what is missing and what was skipped."""
    import numpy as np

    from speckle3d.core.sweep import INERTIAL
    from xsens.logs.contradictions import contradictions

    log = read(log_file, rate_hz, world)
    rows = [
        ("samples", str(len(log)), ""),
        ("duration", f"{log.duration_s:.3f}", "s"),
        ("rate", *((f"{log.rate_hz:.2f}", "samples/s") if math.isfinite(log.rate_hz) else ("unknown", ""))),
        ("lost", str(log.lost), "samples"),
        ("gaps", str(len(log.gaps)), ""),
        ("longest gap", f"{max((gap.duration_s for gap in log.gaps), default=0.0):.3f}", "s"),
        ("own orientation", str(int(log.oriented.sum())), "samples"),
    ]
    for name, unit in zip(INERTIAL, ("m/s^2", "rad/s", "a.u."), strict=True):
        values, spoken = getattr(log, name), name.split("_")[0]
        if values is None or np.isnan(values).all():
            rows.append((spoken, "none", ""))
        else:
            norm = np.nanmedian(np.linalg.norm(values, axis=1))
            rows.append((f"{spoken}, median norm", f"{norm:.4f}", unit))
    told = (*log.notes, *filter(None, contradictions(log).values()))
    rows += [("note", text, "") for text in told]
    emit_rows(rows, as_json)


@imu.command("convert")
def imu_convert(
    log_file: Log,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="CSV to write; or -o OUT.")],
    rate_hz: RateHz = None,
    world: WorldOption = None,
) -> None:
    """Turn a log of any kind into a plain CSV in SI units, on the sensor's own clock."""
    from xsens.logs.textlogs import write_csv

    require_own_place(out, "log", log_file)
    log = read(log_file, rate_hz, world)
    write_csv(out, log)
    tell(log)


@imu.command("orient")
def imu_orient(
    log_file: Log,
    into: Annotated[Path | None, typer.Option(help="Sweep file to put the stream into.")] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--output", help="CSV of the log with this orientation.")
    ] = None,
    method: MethodOption = DEFAULT_SOURCE,
    magnetometer: Magnetometer = True,
    time_offset_s: Annotated[
        float | None,
        typer.Option(
            help="A reading at t belongs to image time t + this (0, or as LOG has it if it is a sweep); see "
            "calibrate clock."
        ),
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration file of this mounting, to go into the sweep with it.")
    ] = None,
    replace_stream: Annotated[
        bool, typer.Option("--replace", help="Replace a stream that the sweep has.")
    ] = False,
    rate_hz: RateHz = None,
    world: WorldOption = None,
    as_json: Json = False,
) -> None:
    """Find the sensor's orientation from its log, and put it into a sweep, on its own clock."""
    from speckle3d.sensor_logs import log_of, ridden_along
    from xsens.logs.textlogs import write_csv

    if into is None and out is None:
        raise InvalidInputError("expected --into SWEEP.h5, -o CSV or both, got neither")
    require_finite_offset(time_offset_s or 0.0)
    if out is not None:
        require_own_place(out, "log", log_file, into, calibration)
    if into is not None and not replace_stream:
        _require_no_stream(into)
    held = ridden_along(log_file)
    log = read(log_file, rate_hz, world) if held is None else log_of(held, log_file.name)
    with naming(str(log_file)):
        rotations, found = orientation_of(log, method, magnetometer)
    if into is not None:
        own = (None, 0.0) if held is None else (held.sensor_from_image, held.time_offset_s)
        mounting, offset_s = _mounting(calibration, time_offset_s, own)
        _attach(into, log, rotations, mounting, offset_s, replace_stream)
    if out is not None:
        write_csv(out, _with(log, rotations))
    tell(log)
    rows = _orientation_rows(log, rotations, found)
    if as_json:
        emit_json({name: value for name, value, _ in rows})
        return
    emit_rows([(name, _shown(value), unit) for name, value, unit in rows], as_json)


@imu.command("record")
def imu_record(
    port: Annotated[str, typer.Argument(help="Serial port of the sensor, as /dev/ttyUSB0 or COM3.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File for the sensor's bytes; or -o OUT.")],
    content: Annotated[str, typer.Option(help="orientation, calibrated, raw, or `as set`.")] = "orientation",
    rate_hz: Annotated[float | None, typer.Option(help="Samples per second; by default as set.")] = None,
    baud: Annotated[
        int | None, typer.Option(help="Of the line; by default the common ones are tried.")
    ] = None,
    duration_s: Annotated[
        float | None, typer.Option(help="Stop after so long; by default at Ctrl-C.")
    ] = None,
    append: Annotated[bool, typer.Option("--append", help="Go on in a file that is there.")] = False,
) -> None:
    """Record a sensor on a serial port; every byte is in the file as soon as it has come."""
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    from xsens.live.device import DeviceSettings
    from xsens.live.recording import record

    settings = DeviceSettings(content, rate_hz, baud)
    console = Console(stderr=True)
    state = None
    try:
        with Live(Text("connecting"), console=console, refresh_per_second=8, transient=True) as live:
            for state in record(port, out, settings, append, duration_s=duration_s or float("inf")):
                live.update(Text(state.line()))
    except KeyboardInterrupt:
        note("stopped")
    if state is not None:
        note(
            f"{state.samples} samples, {state.lost} lost, {state.interruptions} interruptions; bytes in {out}"
        )


def require_finite_offset(time_offset_s: float) -> None:
    """Refuse a clock offset that is NaN or infinite."""
    if not math.isfinite(time_offset_s):
        raise InvalidInputError(f"--time-offset-s: expected a finite number, got {time_offset_s}")


def orientation_of(
    log: ImuLog, source: Source, magnetometer: bool
) -> tuple[TimedRotations, Orientation | None]:
    """Find the orientation of a log; the second result is None for the sensor's own orientation."""
    if source is Source.sensor:
        return log.rotations(), None
    from xsens.fusion.orient import orient
    from xsens.fusion.settings import FusionSettings

    found = orient(log, FusionSettings(use_magnetometer=magnetometer), source.value)
    for text in found.notes:
        note(text)
    return found.rotations, found


def _with(log: ImuLog, rotations: TimedRotations) -> ImuLog:
    """Replace the sensor's own orientation in a log."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    there = np.isin(log.time_s, rotations.time_s)
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (len(log), 1))
    quaternions[there] = rotations.world_from_sensor.as_quat()
    return replace(log, world_from_sensor=Rotation.from_quat(quaternions), oriented=there)


def _mounting(
    calibration: Path | None, time_offset_s: float | None, held: tuple[Rotation | None, float]
) -> tuple[Rotation | None, float]:
    """Mounting and clock offset: as given, else the calibration's, else those the sensor's sweep has."""
    from speckle3d.io.calibrations import read_calibration

    mounting, offset_s = held
    if calibration is not None:
        known = read_calibration(calibration)
        mounting = known.rotation
        offset_s = offset_s if known.time_offset_s is None else known.time_offset_s
    return mounting, offset_s if time_offset_s is None else time_offset_s


def _attach(
    sweep_file: Path,
    log: ImuLog,
    rotations: TimedRotations,
    mounting: Rotation | None,
    time_offset_s: float,
    replace_stream: bool,
) -> None:
    import numpy as np

    from speckle3d.core.sweep import INERTIAL, OrientationSensor
    from speckle3d.io.sweep_writer import attach_orientation

    kept = np.isin(log.time_s, rotations.time_s)
    vectors = {}
    for name in INERTIAL:
        values = getattr(log, name)
        whole = values is not None and bool(np.isfinite(values[kept]).all())
        vectors[name] = values[kept] if whole and kept.sum() == len(rotations) else None
    sensor = OrientationSensor(rotations, mounting, time_offset_s, **vectors)
    covered = _cover(sweep_file, sensor, replace_stream)
    attach_orientation(sweep_file, sensor)
    note(f"orientation of {len(rotations)} samples in {sweep_file}{covered}")


def _require_no_stream(sweep_file: Path) -> None:
    from speckle3d.io.load import load_sweep

    if load_sweep(sweep_file).orientation is not None:
        raise InvalidInputError(
            f"{sweep_file}: expected no orientation sensor's stream, got one: --replace replaces it"
        )


def _cover(sweep_file: Path, sensor: OrientationSensor, replace_stream: bool) -> str:
    """Tell how many frames the stream covers; refuse one that covers none, or replaces one unasked."""
    from speckle3d.io.load import load_sweep

    try:
        sweep = load_sweep(sweep_file)
    except InvalidInputError:
        if replace_stream:
            return ""
        raise
    times_s = sweep.frame_time_s
    frames = int(sensor.covers(times_s).sum())
    covered = f"covers {frames} of {times_s.size} frames"
    if not frames:
        first, last = sensor.readings.time_s[[0, -1]] + sensor.time_offset_s
        raise InvalidInputError(
            f"{sweep_file}: expected a stream that covers frames of the sweep, {times_s[0]:.3f} to "
            f"{times_s[-1]:.3f} s, got one from {first:.3f} to {last:.3f} s: {covered}"
        )
    return f": {covered}"


def _shown(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.5g}"


def _orientation_rows(
    log: ImuLog, rotations: TimedRotations, found: Orientation | None
) -> list[tuple[str, float | str, str]]:
    import numpy as np

    method = Source.sensor if found is None else found.method
    rows: list[tuple[str, float | str, str]] = [
        ("method", method.value, ""),
        ("samples", float(len(rotations)), ""),
        ("duration", log.duration_s, "s"),
    ]
    if found is not None:
        heading = found.standard_deviation_rad[:, 2]
        inclination = np.linalg.norm(found.standard_deviation_rad[:, :2], axis=1) / np.sqrt(2.0)
        of = "heading" if found.magnetic else "heading relative to the start"
        rows += [
            ("inclination, standard deviation, median", float(np.rad2deg(np.median(inclination))), "deg"),
            (f"{of}, standard deviation, median", float(np.rad2deg(np.median(heading))), "deg"),
        ]
        if found.magnetic:
            disturbed = 100.0 * float(np.mean(found.disturbed))
            rows.append(("magnetic field disturbed", disturbed, "% of samples"))
        if log.oriented.any():
            rows += _beside_own(log, rotations)
    return rows


def _beside_own(log: ImuLog, rotations: TimedRotations) -> list[tuple[str, float, str]]:
    """Compare the orientation found with the sensor's own."""
    import numpy as np

    from xsens.accuracy.comparison import compare_orientations

    apart = compare_orientations(rotations, log.rotations())
    return [
        (f"{what}, RMS difference from the sensor's own", float(np.rad2deg(value)), "deg")
        for what, value in (
            ("inclination", apart.inclination_rms_rad),
            ("heading", apart.heading_rms_rad),
            ("heading, constant offset removed", apart.heading_rms_without_offset_rad),
        )
    ]
