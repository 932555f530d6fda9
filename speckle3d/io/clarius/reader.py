"""Sweeps from Clarius raw packages, and what a package holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.printable import printable
from speckle3d.core.sweep import BModeSettings, Frames, ImageGrid, OrientationSensor, RFSettings, Sweep
from speckle3d.io.clarius import imu
from speckle3d.io.clarius.lines import Place, element_pitch_mm, place_of, require_roi
from speckle3d.io.clarius.package import KINDS, Recording, find_recording
from speckle3d.io.clarius.raw import SAMPLES, RawFile, RawFrames, RawHeader, read_header, read_times_ns
from speckle3d.io.clarius.sidecars import Curve, Description, read_description, read_gains, require_short
from speckle3d.io.clarius.spectrum import measured_band_hz
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings, MissingSettingsError
from speckle3d.io.readers import Row

FORMAT = "Clarius raw package"

_ORDER = ("RF", "IQ", "envelope")
_SAME_GAIN_DB = 0.005
"""Gains are written to 0.01 dB."""


@dataclass(frozen=True)
class _Chosen:
    """The raw file that becomes the sweep, with what its yml and its header say."""

    name: str
    said: Description
    raw: RawFile
    header: RawHeader
    times_ns: npt.NDArray[np.int64]


def read_package(path: Path, settings: ImportSettings) -> Sweep:
    """Read the sweep of a package; its frames stay on disk until they are asked for.

    RF is preferred, else I/Q, else the envelope. Times are of the scanner's clock.

    Raises
    ------
    FileError
        If the package cannot be read.
    InvalidInputError
        Naming the file and field that is missing, contradicts another, or makes it no sweep.
    MissingSettingsError
        Naming all that it does not say.
    """
    recording = find_recording(path)
    chosen = _choose(recording)
    said = chosen.said
    place = place_of(said, _is_padded(chosen))
    values = _values(path, chosen, place, settings)
    spacing_mm = 1e3 * values["speed_of_sound_m_s"] / (2.0 * values["sampling_rate_hz"])
    _, vectors, samples = _frames(chosen, place).shape
    grid = ImageGrid(vectors, samples, values["vector_pitch_mm"], spacing_mm, values["first_sample_depth_mm"])
    gains = None if said.kind == "envelope" else _gain_ratios(recording, chosen, grid)
    frames = _frames(chosen, place, gains)
    with naming(said.where):
        signal = _signal(said, values)
    return Sweep(
        frames=cast(Frames, frames),
        grid=grid,
        signal=signal,
        frame_time_s=chosen.times_ns / 1e9,
        orientation=_orientation(recording),
        name=printable(recording.name or path.stem),
        probe=settings.probe or said.probe,
    )


def describe_package(path: Path, settings: ImportSettings) -> list[Row]:
    """Tell what a package holds, also where it is no sweep."""
    recording = find_recording(path)
    rows: list[Row] = [("recording", printable(recording.name) or "without a name", "")]
    for name in KINDS:
        if name in recording.settings:
            rows += _said_rows(recording, name)
    if recording.raw:
        rows += _chosen_rows(recording, path, settings)
    if recording.sensor is not None:
        samples = imu.read_samples(recording.sensor)
        rows += imu.sensor_rows(samples, imu.fits_of(samples))
    return rows


def sensor_of(path: Path) -> tuple[imu.SensorSamples, imu.Fit | None]:
    """Read the sensor's samples of a package, and what its quaternion means; None where nothing fits.

    Raises
    ------
    InvalidInputError
        If the package has no sensor, or its samples make no sense.
    """
    member = find_recording(path).sensor
    if member is None:
        raise InvalidInputError(f"{path}: expected the sensor's samples (_imu.yml), got none")
    samples = imu.read_samples(member)
    return samples, imu.meaning_of(imu.fits_of(samples))


def package_files(path: Path) -> Sequence[Path]:
    """Other files on disk that the sweep's content depends on."""
    return sorted({each.path for each in find_recording(path).members} - {path})


def _choose(recording: Recording) -> _Chosen:
    """Find the raw file that becomes the sweep, and check it against its yml."""
    if not recording.raw:
        raise InvalidInputError(
            f"{recording.path}: expected a raw file (as {recording.name}_rf.raw), got sidecars alone: they "
            "describe frames that are not there"
        )
    described = []
    for name, member in recording.raw.items():
        if name not in recording.settings:
            expected = Path(member.name).name.removesuffix(".lzo").replace(".raw", ".yml")
            raise InvalidInputError(f"{member.where}: expected {expected} beside it, got none")
        require_short(recording.settings[name])
        described.append((name, read_description(recording.settings[name])))
    name, said = min(described, key=lambda each: _ORDER.index(each[1].kind))
    raw = RawFile(recording.raw[name])
    header = read_header(raw)
    _require_same(said, raw, header)
    return _Chosen(name, said, raw, header, read_times_ns(raw, header))


def _require_same(said: Description, raw: RawFile, header: RawHeader) -> None:
    """Refuse a raw file whose header contradicts its yml."""
    for field, expected, found in (
        ("frames", said.frames, header.frames),
        ("number of lines", said.lines, header.lines),
        ("samples per line", said.samples, header.samples),
        ("sample size", said.sample_bytes, header.sample_bytes),
    ):
        if expected != found:
            raise InvalidInputError(
                f"{raw.member.where}: header: expected {field} {expected} as in the yml, got {found}"
            )
    number, parts, _ = SAMPLES[said.kind]
    if header.sample_bytes != number.itemsize * parts:
        raise InvalidInputError(
            f"{raw.member.where}: expected {number.itemsize * parts} bytes a sample of type {said.kind}, got "
            f"{header.sample_bytes}"
        )
    if said.compression.lower() != "none":
        raise InvalidInputError(
            f"{said.where}: compression: expected none, got {said.compression!r}: frames are not decoded"
        )
    require_roi(said)


def _is_padded(chosen: _Chosen) -> bool:
    """Whether what lies outside the region of interest is empty, in the first, middle and last frame."""
    roi = chosen.said.roi
    if roi is None:
        return False
    every = _frames(chosen, Place(slice(None), slice(None), 0.0, 1.0, 0.0))
    for i in {0, len(every) // 2, len(every) - 1}:
        frame = np.array(every.whole(i))
        frame[roi.start_line : roi.end_line + 1, roi.start_sample : roi.end_sample + 1] = 0
        if frame.any():
            return False
    return True


def _frames(chosen: _Chosen, place: Place, gains: FloatArray | None = None) -> RawFrames:
    return RawFrames(chosen.raw, chosen.header, chosen.said.kind, place.lines, place.samples, gains)


def _values(path: Path, chosen: _Chosen, place: Place, settings: ImportSettings) -> dict[str, float]:
    """Numbers of the sweep, the given ones over the package's own; all that lack are asked for at once."""
    said = chosen.said
    element_mm, _ = (None, "") if settings.vector_pitch_mm else element_pitch_mm(said, settings.probe)
    speed = settings.speed_of_sound_m_s or said.speed_of_sound_m_s or SPEED_OF_SOUND_M_S
    rate_hz = settings.sampling_rate_hz or said.sampling_rate_hz
    known = settings.vector_pitch_mm is not None or element_mm is not None
    found: dict[str, float | None] = {
        "sampling_rate_hz": rate_hz,
        "speed_of_sound_m_s": speed,
        # A probe's model is easier told than the distance between its lines.
        "vector_pitch_mm" if known else "probe": (element_mm or 0.0) * place.elements_per_line or None,
        "first_sample_depth_mm": place.first_depth_mm(rate_hz, speed),
    }
    if said.kind == "envelope":
        return settings.over(path, **found, dynamic_range_db=None)
    centre_hz = settings.centre_frequency_hz or said.transmit_frequency_hz
    found["centre_frequency_hz"] = centre_hz
    shifted_hz = None
    if said.kind == "IQ":
        first_mm = settings.first_sample_depth_mm or found["first_sample_depth_mm"] or 0.0
        own_hz = _shifted_by_hz(chosen, place, first_mm, speed / (2e-3 * rate_hz))
        given_hz = settings.demodulation_frequency_hz
        shifted_hz = (own_hz or centre_hz) if given_hz is None else given_hz
        found["demodulation_frequency_hz"] = shifted_hz
    band = None
    if settings.bandwidth_hz is None and centre_hz is not None:
        band = measured_band_hz(cast(Frames, _frames(chosen, place)), rate_hz, centre_hz, shifted_hz)
    return settings.over(path, **found, bandwidth_hz=band)


def _shifted_by_hz(chosen: _Chosen, place: Place, first_mm: float, spacing_mm: float) -> float | None:
    """Demodulation frequency in the middle of a line; None where the yml does not say.

    Where it changes with depth, as 11 to 8 MHz, phases of different depths are not comparable.
    """
    receive = chosen.said.receive
    if receive is None:
        return None
    samples = len(range(chosen.header.samples)[place.samples])
    return receive.at_hz(first_mm + spacing_mm * (samples - 1) / 2)


def _signal(said: Description, values: dict[str, float]) -> RFSettings | BModeSettings:
    if said.kind == "envelope":
        return BModeSettings(values["dynamic_range_db"])
    low, high = cast(tuple[float, float], values["bandwidth_hz"])
    return RFSettings(
        sampling_rate_hz=values["sampling_rate_hz"],
        speed_of_sound_m_s=values["speed_of_sound_m_s"],
        centre_frequency_hz=values["centre_frequency_hz"],
        bandwidth_hz=(low, high),
        demodulation_frequency_hz=values.get("demodulation_frequency_hz"),
    )


def _orientation(recording: Recording) -> OrientationSensor | None:
    if recording.sensor is None:
        return None
    samples, fit = sensor_of(recording.path)
    return None if fit is None else imu.orientation_sensor(samples, fit)


def _curves(recording: Recording, chosen: _Chosen) -> tuple[Curve, ...] | None:
    """Gain curve of each frame; None where the package does not tell.

    The gain file of another kind of the same recording serves too: all kinds see the same analogue gain
    (clariusdev/research, discussion 7).
    """
    for name in (chosen.name, *(each for each in ("env", "iq", "rf") if each != chosen.name)):
        if name not in recording.gains:
            continue
        curves = read_gains(recording.gains[name])
        if not curves:
            continue
        lacking = [int(t) for t in chosen.times_ns if int(t) not in curves]
        if not lacking:
            return tuple(curves[int(t)] or chosen.said.gain for t in chosen.times_ns)
        if name == chosen.name:
            raise InvalidInputError(
                f"{recording.gains[name].where}: expected the gain of the frame at {lacking[0]} ns, got none "
                f"({len(lacking)} of {chosen.times_ns.size} frames)"
            )
    return None


def _gain_ratios(recording: Recording, chosen: _Chosen, grid: ImageGrid) -> FloatArray | None:
    """Amplitude gain relative to the first frame's, shape (frame, sample); None where it is the same."""
    curves = _curves(recording, chosen)
    if curves is None or len(set(curves)) == 1:
        return None
    if () in curves:
        i = curves.index(())
        raise InvalidInputError(
            f"{chosen.said.where}: frame {i}: expected a gain curve as other frames have, got none"
        )
    depth_mm = grid.first_sample_depth_mm + grid.sample_spacing_mm * np.arange(grid.samples)
    gain_db = np.array([np.interp(depth_mm, *np.array(curve).T) for curve in curves])
    apart_db = gain_db - gain_db[0]
    return None if np.abs(apart_db).max() < _SAME_GAIN_DB else 10.0 ** (apart_db / 20.0)


def _said_rows(recording: Recording, name: str) -> list[Row]:
    said = read_description(recording.settings[name])
    raw = recording.raw.get(name)
    file = "none" if raw is None else "packed (.lzo)" if raw.name.endswith(".lzo") else "yes"
    first, last = said.geometry.receive_element[[0, -1]]
    rows: list[Row] = [
        (f"{name}: type", said.kind, ""),
        (f"{name}: raw file", file, ""),
        (f"{name}: frames", str(said.frames), ""),
        (f"{name}: lines x samples", f"{said.lines} x {said.samples}", f"of {said.sample_bytes} bytes"),
        (f"{name}: lines at elements", f"{first:g} to {last:g}", ""),
        (f"{name}: sampling rate", f"{said.sampling_rate_hz / 1e6:g}", "MHz"),
        (f"{name}: delay of the first sample", f"{said.delay_samples:g}", "samples"),
    ]
    if said.geometry.interpolated:
        rows.append((f"{name}: lines", "first and last given, those between evenly spaced", ""))
    for what, value, scale, unit in (
        ("frame rate", said.frame_rate_hz, 1.0, "frames/s"),
        ("transmit frequency", said.transmit_frequency_hz, 1e-6, "MHz"),
        ("imaging depth", said.imaging_depth_mm, 1.0, "mm"),
        ("focal depth", said.focal_depth_mm, 1.0, "mm"),
        ("speed of sound", said.speed_of_sound_m_s, 1.0, "m/s"),
    ):
        if value is not None:
            rows.append((f"{name}: {what}", f"{value * scale:g}", unit))
    if said.gain:
        rows.append((f"{name}: gain", ", ".join(f"{g:g} dB at {d:g} mm" for d, g in said.gain), ""))
    if said.roi is not None:
        roi = said.roi
        where = f"lines {roi.start_line} to {roi.end_line}, samples {roi.start_sample} to {roi.end_sample}"
        rows.append((f"{name}: region of interest", where, ""))
    if said.unused:
        rows.append((f"{name}: fields not read", ", ".join(map(printable, said.unused)), ""))
    return rows


def _chosen_rows(recording: Recording, path: Path, settings: ImportSettings) -> list[Row]:
    """What the sweep is made from, and where its numbers are from."""
    try:
        chosen = _choose(recording)
        padded = _is_padded(chosen)
        place = place_of(chosen.said, padded)
    except InvalidInputError:
        return []  # said where the sweep is
    said = chosen.said
    others = ", ".join(each for each in recording.raw if each != chosen.name) or "none"
    rows: list[Row] = [
        ("sweep is made from", chosen.name, ""),
        ("other raw files", others, ""),
    ]
    if said.roi is not None:
        outside = "empty, left out" if padded else "not empty, kept"
        rows.append(("outside the region of interest", outside, ""))
    element_mm, source = (None, "") if settings.vector_pitch_mm else element_pitch_mm(said, settings.probe)
    pitch = "as given" if settings.vector_pitch_mm else "not said"
    if element_mm is not None:
        pitch = f"{place.elements_per_line:g} elements a line (yml) x {element_mm:g} mm ({source})"
    speed = settings.speed_of_sound_m_s or said.speed_of_sound_m_s or SPEED_OF_SOUND_M_S
    rows += [
        ("vector pitch from", pitch, ""),
        ("first line at element", f"{place.first_element:g}, taken as the image's left", ""),
        ("lines taken as", "parallel, of a linear array: its yml does not say", ""),
        ("first sample's depth from", *_depth_source(place, said, speed, settings)),
        ("speed of sound from", _source(settings.speed_of_sound_m_s, said.speed_of_sound_m_s, "assumed"), ""),
    ]
    if said.kind != "envelope":
        try:
            values = _values(path, chosen, place, settings)
            low, high = (f"{edge / 1e6:.2f}" for edge in cast(tuple[float, float], values["bandwidth_hz"]))
            how = "as given" if settings.bandwidth_hz else "measured at -6 dB in this recording's spectrum"
            rows.append(("band from", f"{low} to {high} MHz, {how}", ""))
        except MissingSettingsError:
            rows.append(("band from", "not said, and not clear in the spectrum", ""))
        centre = _source(settings.centre_frequency_hz, said.transmit_frequency_hz, "not said")
        rows.append(("centre frequency from", centre.replace("its yml", "transmit frequency in its yml"), ""))
    if said.kind == "IQ":
        rows.append(("demodulation frequency from", _shift_source(said, settings), ""))
    return [*rows, ("gain by frame", _gain_said(recording, chosen), "")]


def _depth_source(place: Place, said: Description, speed: float, settings: ImportSettings) -> tuple[str, str]:
    if settings.first_sample_depth_mm is not None:
        return "as given", ""
    depth = place.first_depth_mm(settings.sampling_rate_hz or said.sampling_rate_hz, speed)
    return f"delay samples, less 1 us before depth 0 (assumed): {depth:.3f}", "mm"


def _source(given: float | None, own: float | None, otherwise: str) -> str:
    if given is not None:
        return "as given"
    return otherwise if own is None else "its yml"


def _shift_source(said: Description, settings: ImportSettings) -> str:
    receive = said.receive
    if settings.demodulation_frequency_hz is not None:
        return "as given"
    if receive is None:
        return "transmit frequency: assumed, its yml does not say"
    if receive.shallow_hz == receive.deep_hz:
        return "its yml"
    ends = (
        f"{receive.shallow_hz / 1e6:g} to {receive.deep_hz / 1e6:g} MHz over {receive.filter_depth_mm:g} mm"
    )
    return f"its yml, {ends}: that of the line's middle"


def _gain_said(recording: Recording, chosen: _Chosen) -> str:
    curves = _curves(recording, chosen)
    if curves is None:
        return "not told: taken as the same"
    if len(set(curves)) == 1:
        return "the same in all frames: left as it is"
    grey = chosen.said.kind == "envelope"
    undone = "left in the grey levels" if grey else "undone relative to the first frame"
    return f"differs between frames: {undone}"
