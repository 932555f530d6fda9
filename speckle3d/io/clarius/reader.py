"""Sweeps from Clarius raw packages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ComplexArray, FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.printable import printable
from speckle3d.core.sweep import BModeSettings, Frames, ImageGrid, OrientationSensor, RFSettings, Sweep
from speckle3d.io.clarius import imu
from speckle3d.io.clarius.checks import require_depth, require_times
from speckle3d.io.clarius.demodulation import middle_hz, turns_to
from speckle3d.io.clarius.documents import shown
from speckle3d.io.clarius.gains import GainFactors
from speckle3d.io.clarius.lines import Place, pitch_of, place_of, probe_name, require_roi
from speckle3d.io.clarius.package import Recording, find_recording
from speckle3d.io.clarius.raw import (
    SAMPLES,
    Factors,
    RawFile,
    RawFrames,
    RawHeader,
    read_header,
    read_times_ns,
)
from speckle3d.io.clarius.sidecars import Curve, Description, read_description, read_gains
from speckle3d.io.clarius.spectrum import measured_band_hz, measured_centres_hz
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings

FORMAT = "Clarius raw package"

_ORDER = ("RF", "IQ", "envelope")


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
    try:
        place = place_of(said, is_padded(chosen))
    except InvalidInputError as error:
        others = [member.name for name, member in recording.raw.items() if name != chosen.name]
        if not others:
            raise
        raise InvalidInputError(f"{error}; or give another of its raw files: {', '.join(others)}") from error
    values = values_of(path, chosen, place, settings)
    spacing_mm = 1e3 * values["speed_of_sound_m_s"] / (2.0 * values["sampling_rate_hz"])
    _, vectors, samples = _frames(chosen, place).shape
    grid = ImageGrid(vectors, samples, values["vector_pitch_mm"], spacing_mm, values["first_sample_depth_mm"])
    turns = _turns(chosen, place, values, settings)
    gains = None if said.kind == "envelope" else _gain_factors(recording, chosen, grid, turns)
    frames = _frames(chosen, place, turns if gains is None else gains)
    with naming(said.where):
        signal = _signal(said, values)
    return Sweep(
        frames=cast(Frames, frames),
        grid=grid,
        signal=signal,
        frame_time_s=chosen.times_ns / 1e9,
        orientation=orientation_of(recording),
        name=printable(recording.name or path.stem),
        probe=probe_name(said, settings.probe),
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
    times_ns = read_times_ns(raw, header)
    require_times(raw.member.where, said, times_ns)
    return Chosen(name, said, raw, header, times_ns)


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
            f"{said.where}: compression: expected none, got {shown(said.compression)}: frames are not decoded"
        )
    require_roi(said)


def is_padded(chosen: Chosen) -> bool:
    """Whether what lies outside the region of interest is empty, in the first, middle and last frame."""
    roi = chosen.said.roi
    if roi is None:
        return False
    every = _frames(chosen, Place(slice(None), slice(None), 0.0, 0.0, 1.0, 0.0))
    for i in {0, len(every) // 2, len(every) - 1}:
        frame = np.array(every.whole(i))
        frame[roi.start_line : roi.end_line + 1, roi.start_sample : roi.end_sample + 1] = 0
        if frame.any():
            return False
    return True


def _frames(chosen: Chosen, place: Place, factors: Factors | None = None) -> RawFrames:
    return RawFrames(chosen.raw, chosen.header, chosen.said.kind, place.lines, place.samples, factors)


def values_of(path: Path, chosen: Chosen, place: Place, settings: ImportSettings) -> dict[str, float]:
    """Numbers of the sweep, the given ones over the package's own; all that lack are asked for at once."""
    require_depth(chosen.name, chosen.said, settings)
    pitch = pitch_of(chosen.said, place, settings)
    # A probe's model is easier told than the distance between its lines.
    lateral = {"probe": None} if pitch is None else {"vector_pitch_mm": pitch.vector_mm}
    return settings.over(path, **lateral, **signal_values(chosen, place, settings))


def signal_values(chosen: Chosen, place: Place, settings: ImportSettings) -> dict[str, Any]:
    """Numbers of the sweep but for the distance between lines; None where nothing tells."""
    found = _said_values(chosen, place, settings)
    if chosen.said.kind == "envelope":
        return found | {"dynamic_range_db": settings.dynamic_range_db}
    band: tuple[float, float] | None = settings.bandwidth_hz
    if band is None and _is_heard(found):
        frames = cast(Frames, _frames(chosen, place, _turns(chosen, place, found, settings)))
        about_hz, shifted_hz = found["centre_frequency_hz"], found.get("demodulation_frequency_hz")
        band = measured_band_hz(frames, found["sampling_rate_hz"], about_hz, shifted_hz)
    return found | {"bandwidth_hz": band}


def centres_of(chosen: Chosen, place: Place, settings: ImportSettings) -> tuple[float, float] | None:
    """Centre of the echoes' spectrum near the probe and far from it, Hz; None where nothing tells."""
    found = _said_values(chosen, place, settings)
    if not _is_heard(found):
        return None
    frames = cast(Frames, _frames(chosen, place, _turns(chosen, place, found, settings)))
    shifted_hz = found.get("demodulation_frequency_hz")
    return measured_centres_hz(frames, found["sampling_rate_hz"], found["centre_frequency_hz"], shifted_hz)


def _said_values(chosen: Chosen, place: Place, settings: ImportSettings) -> dict[str, Any]:
    """Numbers that are said or given; None where they are not."""
    said, given = chosen.said, settings
    speed = given.speed_of_sound_m_s or said.speed_of_sound_m_s or SPEED_OF_SOUND_M_S
    rate_hz = given.sampling_rate_hz or said.sampling_rate_hz
    first_mm = given.first_sample_depth_mm
    found: dict[str, Any] = {
        "sampling_rate_hz": rate_hz,
        "speed_of_sound_m_s": speed,
        "first_sample_depth_mm": place.first_depth_mm(rate_hz, speed) if first_mm is None else first_mm,
    }
    if said.kind == "envelope":
        return found
    found["centre_frequency_hz"] = given.centre_frequency_hz or said.transmit_frequency_hz
    if said.kind == "IQ":
        shifted_hz = given.demodulation_frequency_hz
        if shifted_hz is None and said.receive is not None:
            shifted_hz = middle_hz(said.receive, _depths_mm(chosen, place, found))
        found["demodulation_frequency_hz"] = shifted_hz
    return found


def _is_heard(found: Mapping[str, Any]) -> bool:
    """Whether the frequencies of a spectrum can be told."""
    return all(found.get(name, True) for name in ("centre_frequency_hz", "demodulation_frequency_hz"))


def _depths_mm(chosen: Chosen, place: Place, found: Mapping[str, Any]) -> FloatArray:
    """Depth of each kept sample as the scanner counts it, or else as it is given."""
    rate_hz, speed_m_s = found["sampling_rate_hz"], found["speed_of_sound_m_s"]
    counted_mm, most_mm = place.first_depth_mm(rate_hz, speed_m_s), chosen.said.imaging_depth_mm or np.inf
    if counted_mm is None or counted_mm > most_mm:
        counted_mm = found["first_sample_depth_mm"] or 0.0
    samples = np.arange(len(range(chosen.header.samples)[place.samples]))
    return np.asarray(counted_mm + samples * speed_m_s / (2e-3 * rate_hz))


def _turns(
    chosen: Chosen, place: Place, values: Mapping[str, Any], settings: ImportSettings
) -> ComplexArray | None:
    """Factors that make I/Q as if shifted down by one frequency, shape (1, sample); None where they are."""
    receive = chosen.said.receive
    if chosen.said.kind != "IQ" or receive is None or settings.demodulation_frequency_hz is not None:
        return None
    depths_mm = _depths_mm(chosen, place, values)
    turns = turns_to(values["demodulation_frequency_hz"], receive, depths_mm, values["sampling_rate_hz"])
    return None if turns is None else turns[None]


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


def _gain_factors(
    recording: Recording, chosen: Chosen, grid: ImageGrid, turns: ComplexArray | None
) -> GainFactors | None:
    """The first frame's gain over each one's, times `turns`; None where it is the same."""
    curves = curves_of(recording, chosen)
    if curves is None or len(set(curves)) == 1:
        return None
    if () in curves:
        i = curves.index(())
        raise InvalidInputError(
            f"{chosen.said.where}: frame {i}: expected a gain curve as other frames have, got none"
        )
    depth_mm = np.asarray(grid.first_sample_depth_mm + grid.sample_spacing_mm * np.arange(grid.samples))
    found = GainFactors(depth_mm, curves, turns)
    return found if found.differ else None
