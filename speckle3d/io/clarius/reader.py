"""Sweeps from Clarius raw packages: one object, read once, that says what the files do.

Trusted for the line pitch is the yml's ``rx element``, the place of a line in elements of the array, times
the distance between elements. That is given by ``element_pitch_mm``, by the yml's probe where it says, or by
the probe's model, in this order; ``vector_pitch_mm`` replaces the product. Lines that are steered, unevenly
spaced, or repeated (several packets a line, as in Doppler modes) are refused. The first line is taken as the
left of the image.

The first sample's depth is (``delay samples`` / ``sampling rate`` - 1 us) x c / 2. The maker calls the
samples "leading samples before the first valid sample (acquisition delay)" [1]_. In every B-mode recording
at hand they are 1.00 to 1.07 us, whatever the sampling rate, while the samples after them alone make up the
imaging depth (780 of its region of interest x 0.0513 mm = 40.04 mm of 40; 585: 30.03 of 30; RF, 3120: 40.04
of 40): depth is counted from the first sample, and 1 us passes before, as in the lens. A Doppler recording
has 7.2 us: its region begins at 4.8 mm. That the microsecond is not depth is concluded from these, not
documented: were it depth, all samples lay 0.77 mm deeper. Lengths do not depend on it;
``first_sample_depth_mm`` replaces it.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md).
.. [2] clariusdev/research, "Beamformed RF Acquisition" (docs/rf-frame-rate.md), "Probe reference".
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid

from speckle3d.core.arrays import ComplexArray, FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.printable import printable
from speckle3d.io.clarius.imu import SensorSamples, read_samples
from speckle3d.io.clarius.package import Files, find_files
from speckle3d.io.clarius.raw import ClariusFile, read_header
from speckle3d.io.clarius.sidecars import Description
from speckle3d.io.clarius.spectrum import band_hz
from speckle3d.io.frames import FileFrames
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings
from speckle3d.io.recordings import Recording, Row, Value, step_of

FORMAT = "Clarius raw package"

ELEMENT_PITCH_MM = {"L20HD3": 0.13, "L15HD3": 0.26, "L7HD3": 0.2, "PALHD3": 0.26}
"""Of the linear arrays in the maker's table of HD3 probes [2]_; of the PAL, its linear side."""

CONVEX = ("C3", "C7", "EC7", "PH", "PA2", "PA", "TV")
"""Models whose lines are not parallel."""

BEFORE_DEPTH_S = 1e-6
"""Delay that is not depth; see above."""

_ORDER = ("RF", "IQ", "envelope")
_SAID = (
    "type", "frames", "frame rate", "sampling rate", "delay samples", "transmit frequency", "imaging depth",
    "vsound", "speed of sound",
)  # fmt: skip
_OWN = "its yml"


def open_package(path: Path, settings: ImportSettings) -> Recording:
    """Read a package: RF is preferred, else I/Q, else the envelope. Times are of the scanner's clock."""
    files = find_files(path)
    rows: list[Row] = [("recording", printable(files.name) or "without a name", "")]
    sensor, lost = None, list[str]()
    try:
        sensor = _sensor(files)
        rows += [] if sensor is None else sensor.rows()
    except (InvalidInputError, FileError) as error:
        lost.append(f"the sensor is left out: {error}")
    for kind, member in files.yml.items():
        with suppress(InvalidInputError, FileError):  # which is told where the sweep is
            said = Description(member)
            rows += [(f"{kind}: {name}", said.text(name), "") for name in _SAID if said.text(name)]
    return Recording.of(path, settings, rows, lambda: _recording(files, settings, sensor, lost, rows))


def sensor_of(path: Path) -> SensorSamples:
    """Read the sensor's samples of a package.

    Raises
    ------
    InvalidInputError
        If the package has no sensor, or its samples make no sense.
    """
    sensor = _sensor(find_files(path))
    if sensor is None:
        raise InvalidInputError(f"{path}: expected the sensor's samples (_imu.yml), got none")
    return sensor


def _sensor(files: Files) -> SensorSamples | None:
    return read_samples(files.yml["imu"]) if "imu" in files.yml else None


def package_files(path: Path) -> Sequence[Path]:
    """Other files on disk that the sweep's content depends on."""
    files = find_files(path)
    return sorted({member.path for member in (*files.raw.values(), *files.yml.values())} - {path})


def _recording(
    files: Files, settings: ImportSettings, sensor: SensorSamples | None, remarks: list[str], rows: list[Row]
) -> Recording:
    """What a package holds, as a recording."""
    said, kind = _chosen(files)
    rows.append(("sweep is made from", kind, ""))
    others = [member.name for other, member in files.raw.items() if other != kind]
    file = read_header(files.raw[kind], said)
    file = replace(file, kept=_kept(file, said))
    element, per_line = _place(said, file, others)
    rows.append(("first line at element", f"{element:g}, taken as the image's left", ""))
    probe = settings.probe or said.probe
    pitch = _pitch(said, per_line, settings)
    spreading = _spreading(said, file, element, per_line, pitch, probe)

    own_rate_hz = said.number("sampling rate", unit="Hz")
    own_speed = said.optional("vsound", unit="m/s") or said.optional("speed of sound", unit="m/s")
    rate_hz = settings.sampling_rate_hz or own_rate_hz
    spacing_mm = 1e3 * (settings.speed_of_sound_m_s or own_speed or SPEED_OF_SOUND_M_S) / (2.0 * rate_hz)
    own_first_mm = _first_mm(said, file, rate_hz, spacing_mm)
    first_mm = settings.first_sample_depth_mm if own_first_mm is None else own_first_mm
    depths_mm = (first_mm or 0.0) + spacing_mm * np.arange(file.shape[2])
    centre_hz = said.optional("transmit frequency", unit="Hz")
    values = {
        "first_sample_depth_mm": Value(
            own_first_mm, "delay samples, less 1 us before depth 0 (assumed)", _OWN
        ),
        "vector_pitch_mm": pitch,
        "row_spacing_mm": Value(spacing_mm, f"of {rate_hz / 1e6:g} MHz", _OWN),
        "sampling_rate_hz": Value(own_rate_hz, "", _OWN),
        "centre_frequency_hz": Value(centre_hz, "transmit frequency", _OWN),
        **spreading,
    }
    if own_speed is not None:
        values["speed_of_sound_m_s"] = Value(own_speed, "", _OWN)
    shift_hz, given_hz = None, settings.demodulation_frequency_hz
    if said.kind == "IQ" and (receive := said.receive) is not None:
        shallow_hz, deep_hz, filter_mm = receive
        slid_hz = np.interp(depths_mm, [0.0, filter_mm], [shallow_hz, deep_hz])
        shift_hz = float(np.interp(depths_mm[[0, -1]].mean(), [0.0, filter_mm], [shallow_hz, deep_hz]))
        if shallow_hz != deep_hz and given_hz is None:
            file = replace(file, turns=_turns(slid_hz - shift_hz, rate_hz))
            remarks.append(
                f"demodulation frequency from its yml: {shallow_hz / 1e6:g} to {deep_hz / 1e6:g} MHz over "
                f"{filter_mm:g} mm, turned to that of the line's middle"
            )
    values["demodulation_frequency_hz"] = Value(shift_hz, "of the lines' middle", _OWN)
    if sensor is not None:
        remarks += sensor.remarks
        if sensor.fit is None:
            why = "is missing" if sensor.quaternion is None else "does not agree with gravity"
            remarks.append(
                f"the sensor's quaternion {why}: the sweep has no orientation, "
                f"which `speckle3d imu orient {files.path} --into SWEEP.h5` finds"
            )
    narrow = np.int16 if said.kind == "IQ" and file.turns is None else None
    frames = FileFrames(file.member.path, file, file.shape, file.dtype, narrow)
    shift_hz = shift_hz if given_hz is None else given_hz
    sent_hz = settings.centre_frequency_hz or centre_hz
    is_known = said.kind == "RF" or (said.kind == "IQ" and shift_hz is not None)
    if settings.bandwidth_hz is None and sent_hz and is_known:
        band = band_hz(frames, rate_hz, sent_hz, shift_hz if said.kind == "IQ" else None)
        if band is not None:
            values["bandwidth_hz"] = Value(band, "measured at -6 dB in this recording", "the spectrum")
            remarks.append(
                "the band is measured in this recording: recordings that share curves need "
                f"--bandwidth-hz {band[0]:.4g} {band[1]:.4g}"
            )
    return Recording(
        files.path,
        settings,
        frames,
        values,
        time_s=file.records()["time"] / 1e9,
        orientation=None if sensor is None else sensor.orientation,
        # In one spelling, so that curves and calibrations of a probe are found to be of it.
        probe=f"Clarius {_model(probe)}" if _model(probe) in ELEMENT_PITCH_MM else probe,
        name=files.name or files.path.stem,
        asked=dict.fromkeys(("vector_pitch_mm", "column_pitch_mm"), "element_pitch_mm" if probe else "probe"),
        assumptions=() if spreading else ("parallel lines of a linear array",),
        remarks=tuple(remarks),
    )


def _chosen(files: Files) -> tuple[Description, str]:
    """What the yml of the raw file says that becomes the sweep, and which that is."""
    for member in files.raw.values():
        if member.kind not in files.yml:
            raise InvalidInputError(f"{member.where}: expected its yml beside it, got none")
    if not files.raw:
        raise InvalidInputError(
            f"{files.path}: expected a raw file (as {files.name}_rf.raw), got sidecars alone: they describe "
            "frames that are not there"
        )
    said = {kind: Description(files.yml[kind]) for kind in files.raw}
    kind = min(said, key=lambda kind: _ORDER.index(said[kind].kind))
    return said[kind], kind


def _kept(file: ClariusFile, said: Description) -> tuple[slice, slice]:
    """Lines and samples kept: the region of interest, if there is nothing beside it in three frames."""
    whole, region = (slice(0, said.lines), slice(0, said.samples)), said.region
    read = file()
    for i in {0, file.frames // 2, file.frames - 1} if region is not None else ():
        frame = np.array(read(i))
        frame[region] = 0
        if frame.any():
            return whole
    return region or whole


def _place(said: Description, file: ClariusFile, others: list[str]) -> tuple[float, float]:
    """Place of the first kept line in the array, and the distance between lines, in elements.

    Raises
    ------
    InvalidInputError
        Naming the line that is steered, unevenly spaced or repeated.
    """
    advice = f"; or give another of its raw files: {', '.join(others)}" if others else ""
    elements, angle_deg = said.places.T
    if (steered := np.flatnonzero(angle_deg)).size:
        i = int(steered[0])
        raise InvalidInputError(
            f"{said.where}: lines[{i}]: angle: expected 0 (lines that are not steered), got "
            f"{angle_deg[i]:g} deg, and {steered.size} of {said.lines} lines steered: record without "
            f"steering and Doppler{advice}"
        )
    elements = elements[file.kept[0]]
    try:
        return float(elements[0]), step_of(elements, f"{said.where}: lines, rx element")
    except InvalidInputError as error:
        raise InvalidInputError(f"{error}: packets of a Doppler mode are no image{advice}") from error


def _pitch(said: Description, per_line: float, settings: ImportSettings) -> Value:
    """Distance between lines at the array, mm: of the elements' as given, by the yml, or a table's."""
    model = _model(settings.probe or said.probe)
    pitches = {
        "as given": settings.element_pitch_mm,
        _OWN: _measure(said, "pitch"),
        f"the maker's table, {model}": ELEMENT_PITCH_MM.get(model),
    }
    for source, element_mm in pitches.items():
        if element_mm is not None:
            words = f"{per_line:g} elements a line (yml) x {element_mm:g} mm ({source})"
            return Value(element_mm * per_line, words, _OWN)
    return Value(settings.vector_pitch_mm, "--vector-pitch-mm")


def _spreading(
    said: Description, file: ClariusFile, element: float, per_line: float, pitch: Value, probe: str
) -> dict[str, Value]:
    """Where the lines of a curved array lie; of a curved model without its radius, that it is lacking."""
    radius_mm = _measure(said, "radius")
    if not radius_mm and not _model(probe).startswith(CONVEX):
        return {}
    values = {"array_radius_mm": Value(radius_mm, "", _OWN), "line_angles_deg": Value()}
    if radius_mm and pitch.value is not None:
        last = element + (file.shape[1] - 1) * per_line
        elements = said.optional("probe", "elements")
        middle = (elements - 1) / 2 if elements else (element + last) / 2
        angles = np.rad2deg((np.array([element, last]) - middle) * pitch.value / per_line / radius_mm)
        values["line_angles_deg"] = Value(tuple(angles.tolist()), f"of lines {pitch.source}", _OWN)
    return values


def _measure(said: Description, name: str) -> float | None:
    """A measure of the probe in mm, where its yml describes it and does not name it."""
    return None if said.probe else said.optional("probe", name, unit="mm")


def _first_mm(said: Description, file: ClariusFile, rate_hz: float, spacing_mm: float) -> float | None:
    """Depth of the first kept sample as the scanner counts it; None where it is not said, or above 0.

    Less than a sample above is 0: the delay is a whole number of samples.
    """
    if (delay := said.optional("delay samples")) is None:
        return None
    after = delay + (file.kept[1].start or 0) - BEFORE_DEPTH_S * rate_hz
    return max(after, 0.0) * spacing_mm if after > -1.0 else None


def _turns(apart_hz: FloatArray, rate_hz: float) -> ComplexArray:
    """Factors that make I/Q as if shifted down by one frequency, shape (sample,).

    The scanner's demodulation frequency falls along a straight line with depth, as from 11 to 8 MHz; a sweep
    has one. Samples are turned as if the oscillator had stayed at that of the line's middle, which takes the
    oscillator's phase to be the integral of its frequency: so it is where a frequency is swept, but it is not
    documented. Left as they are, simulated I/Q shifted down by 9 to 6 MHz gave lengths 10 % off, and turned
    back 0.001 % from those of RF.
    """
    cycles = cumulative_trapezoid(apart_hz, initial=0) / rate_hz
    return np.asarray(np.exp(2j * np.pi * cycles))


def _model(named: str) -> str:
    return re.sub(r"[^A-Z0-9]", "", named.upper()).removeprefix("CLARIUS")
