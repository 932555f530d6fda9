"""Sweeps from Clarius raw packages."""

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
from speckle3d.io.clarius.package import Recording, find_recording
from speckle3d.io.clarius.raw import SAMPLES, RawFile, RawFrames, RawHeader, read_header, read_times_ns
from speckle3d.io.clarius.sidecars import Curve, Description, read_description, read_gains
from speckle3d.io.clarius.spectrum import measured_band_hz
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings

FORMAT = "Clarius raw package"

_ORDER = ("RF", "IQ", "envelope")
_SAME_GAIN_DB = 0.005
"""Gains are written to 0.01 dB."""


@dataclass(frozen=True)
class Chosen:
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
    chosen = choose(recording)
    said = chosen.said
    place = place_of(said, is_padded(chosen))
    values = values_of(path, chosen, place, settings)
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
        orientation=orientation_of(recording),
        name=printable(recording.name or path.stem),
        probe=settings.probe or said.probe,
    )


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


def choose(recording: Recording) -> Chosen:
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
        described.append((name, read_description(recording.settings[name])))
    name, said = min(described, key=lambda each: _ORDER.index(each[1].kind))
    raw = RawFile(recording.raw[name])
    header = read_header(raw)
    _require_same(said, raw, header)
    return Chosen(name, said, raw, header, read_times_ns(raw, header))


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


def is_padded(chosen: Chosen) -> bool:
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


def _frames(chosen: Chosen, place: Place, gains: FloatArray | None = None) -> RawFrames:
    return RawFrames(chosen.raw, chosen.header, chosen.said.kind, place.lines, place.samples, gains)


def values_of(path: Path, chosen: Chosen, place: Place, settings: ImportSettings) -> dict[str, float]:
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
        first_mm = place.first_depth_mm(rate_hz, speed)
        own_hz = _shifted_by_hz(chosen, place, first_mm, speed / (2e-3 * rate_hz))
        given_hz = settings.demodulation_frequency_hz
        shifted_hz = (own_hz or centre_hz) if given_hz is None else given_hz
        found["demodulation_frequency_hz"] = shifted_hz
    band = None
    if settings.bandwidth_hz is None and centre_hz is not None:
        band = measured_band_hz(cast(Frames, _frames(chosen, place)), rate_hz, centre_hz, shifted_hz)
    return settings.over(path, **found, bandwidth_hz=band)


def _shifted_by_hz(chosen: Chosen, place: Place, first_mm: float, spacing_mm: float) -> float | None:
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


def orientation_of(recording: Recording) -> OrientationSensor | None:
    """Orientation stream of a recording; None without a sensor, or if its quaternion cannot be believed."""
    if recording.sensor is None:
        return None
    samples, fit = sensor_of(recording.path)
    return None if fit is None else imu.orientation_sensor(samples, fit)


def curves_of(recording: Recording, chosen: Chosen) -> tuple[Curve, ...] | None:
    """Gain curve of each frame; None where the package does not tell.

    The gain file of another kind of the same recording serves too: all kinds see the same analogue gain
    (answers of the maker in clariusdev/research).
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


def _gain_ratios(recording: Recording, chosen: Chosen, grid: ImageGrid) -> FloatArray | None:
    """Amplitude gain relative to the first frame's, shape (frame, sample); None where it is the same."""
    curves = curves_of(recording, chosen)
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
