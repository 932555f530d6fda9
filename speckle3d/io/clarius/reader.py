"""Sweeps from Clarius raw packages: one object, read once, that says what the files do."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ComplexArray, FloatArray, IntArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.printable import printable
from speckle3d.io.clarius import imu
from speckle3d.io.clarius.lines import BEFORE_DEPTH_S, Place, pitch_of, place_of, probe_name
from speckle3d.io.clarius.package import KINDS, Files, find_files
from speckle3d.io.clarius.raw import ClariusFile, Gain, RawHeader, read_header
from speckle3d.io.clarius.sidecars import Curve, Description, read_description, read_gains
from speckle3d.io.clarius.spectrum import measured_band_hz, measured_centres_hz
from speckle3d.io.frames import FileFrames
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings
from speckle3d.io.pose_paths import left_out, rising
from speckle3d.io.recordings import Recording, Row, Value, rate_of

FORMAT = "Clarius raw package"

_ORDER = ("RF", "IQ", "envelope")
_CUT = (
    "the tar file ends without the blocks that close one: it may be truncated, and files missing, as the "
    "sensor's"
)
_MOST_RISE, _MOST_ABOVE = 1.05, 1.15
"""Of the echoes' centre: far from the probe over near, and near over what was sent. On a simulated phantom
0.91 and 0.79; with the other sign of Q 1.05 and 1.22; with another phase of a falling oscillator 1.16 and
0.87."""
_SAME_DB = 0.005
"""Gains are written to 0.01 dB."""
_DEPTH = 0.1
"""Share by which the samples may miss the imaging depth untold: 1.3 % in every recording at hand."""
_OFF_RATE = 10.0
"""RF comes with every third frame or so, and the rate is not constant; a wrong unit of time is 1000."""


def open_package(path: Path, settings: ImportSettings) -> Recording:
    """Read a package: RF is preferred, else I/Q, else the envelope. Times are of the scanner's clock."""
    package = Package(find_files(path), settings)
    try:
        return package.recording()
    except (InvalidInputError, FileError) as error:
        return Recording(path, settings, rows=tuple(package.rows()), fault=error)


def sensor_of(path: Path) -> tuple[imu.SensorSamples, imu.Fit | None]:
    """Read the sensor's samples of a package, and its quaternion; None where that is not believed.

    Raises
    ------
    InvalidInputError
        If the package has no sensor, or its samples make no sense.
    """
    sensor = Package(find_files(path), ImportSettings()).sensor
    if sensor is None:
        raise InvalidInputError(f"{path}: expected the sensor's samples (_imu.yml), got none")
    return sensor


def package_files(path: Path) -> Sequence[Path]:
    """Other files on disk that the sweep's content depends on."""
    return sorted({member.path for member in find_files(path).members} - {path})


class Package:
    """A package and the settings over it; each of its files is read once, when it is needed."""

    def __init__(self, files: Files, settings: ImportSettings) -> None:
        self.files, self.settings = files, settings

    @cached_property
    def descriptions(self) -> dict[str, Description]:
        """What the yml files say, by `KINDS`."""
        return {name: read_description(member) for name, member in self.files.settings.items()}

    @cached_property
    def chosen(self) -> str:
        """Name of the raw file that becomes the sweep."""
        if not self.files.raw:
            raise InvalidInputError(
                f"{self.files.path}: expected a raw file (as {self.files.name}_rf.raw), got sidecars alone: "
                "they "
                "describe frames that are not there"
            )
        for name, member in self.files.raw.items():
            if name not in self.files.settings:
                expected = Path(member.name).name.removesuffix(".lzo").replace(".raw", ".yml")
                raise InvalidInputError(f"{member.where}: expected {expected} beside it, got none")
        return min(self.files.raw, key=lambda name: _ORDER.index(self.descriptions[name].kind))

    @property
    def said(self) -> Description:
        """What the yml of the sweep's raw file says."""
        return self.descriptions[self.chosen]

    @cached_property
    def header(self) -> tuple[RawHeader, npt.NDArray[np.int64]]:
        """The raw file's header, and times of its frames in nanoseconds."""
        return read_header(self.files.raw[self.chosen], self.said)

    @cached_property
    def images(self) -> IntArray:
        """Frames whose time is after the one before."""
        times_ns = self.header[1]
        return rising((times_ns - times_ns[0]).astype(float))

    @cached_property
    def sensor(self) -> tuple[imu.SensorSamples, imu.Fit | None] | None:
        """The sensor's samples and its quaternion."""
        if self.files.sensor is None:
            return None
        samples = imu.read_samples(self.files.sensor)
        return samples, imu.fit_of(samples)

    @cached_property
    def is_padded(self) -> bool:
        """Whether what lies outside the region of interest is empty, in the first, middle and last frame."""
        roi, count = self.said.roi, self.header[0].frames
        if roi is None:
            return False
        read = self._file()()
        for i in {0, count // 2, count - 1}:
            frame = np.array(read(i))
            frame[roi.start_line : roi.end_line + 1, roi.start_sample : roi.end_sample + 1] = 0
            if frame.any():
                return False
        return True

    @cached_property
    def place(self) -> Place:
        """Where the samples lie."""
        try:
            return place_of(self.said, self.is_padded)
        except InvalidInputError as error:
            others = [member.name for name, member in self.files.raw.items() if name != self.chosen]
            if not others:
                raise
            raise InvalidInputError(
                f"{error}; or give another of its raw files: {', '.join(others)}"
            ) from error

    @property
    def rate_hz(self) -> float:
        """Sampling rate."""
        return self.settings.sampling_rate_hz or self.said.sampling_rate_hz

    @property
    def speed_m_s(self) -> float:
        """Speed of sound."""
        return self.settings.speed_of_sound_m_s or self.said.speed_of_sound_m_s or SPEED_OF_SOUND_M_S

    @property
    def spacing_mm(self) -> float:
        """Distance between samples."""
        return 1e3 * self.speed_m_s / (2.0 * self.rate_hz)

    def recording(self) -> Recording:
        """What the package holds, as a recording."""
        values = self._values()
        file = self._file(self.place, self._turns(values), self._gain())
        is_plain = file.turns is None and file.gain is None
        narrow = np.int16 if self.said.kind == "IQ" and is_plain else None
        frames = FileFrames(
            self.files.raw[self.chosen].path, file, file.shape, file.dtype, narrow, self.images.tolist()
        )
        times_s = self.header[1][self.images] / 1e9
        orientation = None
        if self.sensor is not None and self.sensor[1] is not None:
            orientation = imu.orientation_sensor(self.sensor[0], self.sensor[1])
        asked = dict.fromkeys(("vector_pitch_mm", "column_pitch_mm"), "probe")
        return Recording(
            self.files.path,
            self.settings,
            frames,
            values,
            time_s=times_s,
            orientation=orientation,
            probe=probe_name(self.said, self.settings.probe),
            name=self.files.name or self.files.path.stem,
            asked=asked,
            assumptions=("parallel lines of a linear array",),
            rows=tuple(self.rows()),
            remarks=tuple(self._remarks(values, times_s)),
        )

    def _file(
        self, place: Place | None = None, turns: ComplexArray | None = None, gain: Gain | None = None
    ) -> ClariusFile:
        slices = (slice(None), slice(None)) if place is None else (place.lines, place.samples)
        member, header = self.files.raw[self.chosen], self.header[0]
        return ClariusFile(member, header, self.said.kind, *slices, turns, gain)

    def _values(self) -> dict[str, Value]:
        """Numbers of the sweep and where they are from."""
        said, settings, own = self.said, self.settings, "its yml"
        pitch = pitch_of(said, self.place, settings)
        first_mm = self.place.first_depth_mm(self.rate_hz, self.speed_m_s)
        values = {
            "first_sample_depth_mm": Value(
                first_mm, "delay samples, less 1 us before depth 0 (assumed)", own
            ),
            "vector_pitch_mm": Value() if pitch is None else Value(*pitch, own),
        }
        if said.speed_of_sound_m_s is not None:
            values["speed_of_sound_m_s"] = Value(said.speed_of_sound_m_s, "", own)
        if said.kind == "envelope":
            values["column_pitch_mm"] = values["vector_pitch_mm"]
            values["row_spacing_mm"] = Value(self.spacing_mm, f"of {self.rate_hz / 1e6:g} MHz", own)
            return values
        values["sampling_rate_hz"] = Value(said.sampling_rate_hz, "", own)
        values["centre_frequency_hz"] = Value(said.transmit_frequency_hz, "transmit frequency", own)
        if said.kind == "IQ" and said.receive is not None:
            depths = self._depths_mm()
            middle = float(said.receive.at_hz(float(depths[0] + depths[-1]) / 2))
            values["demodulation_frequency_hz"] = Value(middle, "of the lines' middle", own)
        if settings.bandwidth_hz is None and (heard := self._heard(values)) is not None:
            band = measured_band_hz(*heard)
            values["bandwidth_hz"] = Value(band, "measured at -6 dB in this recording", "the spectrum")
        return values

    def _heard(self, values: dict[str, Value]) -> tuple[Any, float, float, float | None] | None:
        """Frames and the frequencies by which their spectrum is measured; None where those are not known."""
        given = self.settings
        centre = given.centre_frequency_hz or values["centre_frequency_hz"].value
        shift = given.demodulation_frequency_hz
        if shift is None:
            shift = values.get("demodulation_frequency_hz", Value()).value
        if not centre or (self.said.kind == "IQ" and shift is None):
            return None
        file = self._file(self.place, self._turns(values))
        frames = FileFrames(self.files.path, file, file.shape, file.dtype)
        return frames, self.rate_hz, centre, shift

    def _depths_mm(self) -> FloatArray:
        """Depth of each kept sample as the scanner counts it, or else as it is given."""
        first_mm, most_mm = (
            self.place.first_depth_mm(self.rate_hz, self.speed_m_s),
            self.said.imaging_depth_mm or np.inf,
        )
        if first_mm is None or first_mm > most_mm:
            first_mm = self.settings.first_sample_depth_mm or 0.0
        count = len(range(self.said.samples)[self.place.samples])
        return np.asarray(first_mm + np.arange(count) * self.spacing_mm)

    def _turns(self, values: dict[str, Value]) -> ComplexArray | None:
        """Factors that make I/Q as if shifted down by one frequency, shape (sample,); None where they are.

        The scanner's demodulation frequency falls along a straight line with depth, as from 11 to 8 MHz; a
        sweep has one. Samples are turned as if the oscillator had stayed at that of the line's middle, which
        takes the oscillator's phase to be the integral of its frequency: so it is where a frequency is swept,
        but it is not documented. Left as they are, simulated I/Q shifted down by 9 to 6 MHz gave lengths 10 %
        off, and turned back 0.001 % from those of RF.
        """
        receive = self.said.receive
        is_iq = self.said.kind == "IQ" and self.settings.demodulation_frequency_hz is None
        if not is_iq or receive is None or receive.shallow_hz == receive.deep_hz:
            return None
        apart = receive.at_hz(self._depths_mm()) - values["demodulation_frequency_hz"].value
        cycles = np.concatenate([[0.0], np.cumsum((apart[1:] + apart[:-1]) / 2)]) / self.rate_hz
        return np.asarray(np.exp(2j * np.pi * cycles))

    @cached_property
    def curves(self) -> tuple[Curve, ...] | None:
        """Gain curve of each frame; None where the package does not tell.

        The gain file of another kind of the same recording serves too: all kinds see the same analogue gain
        (answers of the maker in clariusdev/research).
        """
        times_ns = self.header[1].tolist()
        for name in (self.chosen, *(other for other in KINDS[::-1] if other != self.chosen)):
            if name not in self.files.gains:
                continue
            curves = read_gains(self.files.gains[name])
            lacking = [time_ns for time_ns in times_ns if time_ns not in curves]
            if curves and not lacking:
                return tuple(curves[time_ns] or self.said.gain for time_ns in times_ns)
            if curves and name == self.chosen:
                raise InvalidInputError(
                    f"{self.files.gains[name].where}: expected the gain of the frame at {lacking[0]} ns, "
                    "got none "
                    f"({len(lacking)} of {len(times_ns)} frames)"
                )
        return None

    def _gain(self) -> Gain | None:
        """Gain to undo relative to the first frame; None where it is the same, or of an envelope."""
        curves = self.curves
        if curves is None or len(set(curves)) == 1 or self.said.kind == "envelope":
            return None
        if () in curves:
            raise InvalidInputError(
                f"{self.said.where}: frame {curves.index(())}: expected a gain curve as other frames have, "
                "got "
                "none"
            )
        gain = Gain(self._depths_mm(), curves)
        first_of = {curve: i for i, curve in reversed(list(enumerate(curves)))}
        off_db = [np.abs(20 * np.log10(gain.factors(i))).max() for i in first_of.values()]
        return gain if max(off_db) >= _SAME_DB else None

    def _reaches_mm(self) -> tuple[float, float]:
        """Depth of the end of the region of interest, and of the samples."""
        said, start_mm = self.said, self.settings.first_sample_depth_mm
        if start_mm is None:
            delay = (said.delay_samples or 0.0) - BEFORE_DEPTH_S * self.rate_hz
            start_mm = max(delay * self.spacing_mm, 0.0)
        last = said.samples if said.roi is None else said.roi.end_sample + 1
        return start_mm + last * self.spacing_mm, start_mm + said.samples * self.spacing_mm

    def _remarks(self, values: dict[str, Value], times_s: FloatArray) -> list[str]:
        """What was measured, assumed or left out where the sweep is made."""
        said, settings, count = self.said, self.settings, self.header[0].frames
        repeated = {"with a time that is not after the one before": count - self.images.size}
        notes = left_out("images", count, repeated, times_s)
        depth_mm, (low_mm, high_mm) = said.imaging_depth_mm, self._reaches_mm()
        if depth_mm and not (low_mm <= (1 + _DEPTH) * depth_mm and high_mm >= (1 - _DEPTH) * depth_mm):
            notes.append(
                f"the samples reach {high_mm:.4g} mm, and the imaging depth in the yml is {depth_mm:g} mm: "
                "the "
                "region of interest is another, or the sampling rate"
            )
        rate_hz, expected_hz = rate_of(times_s), said.frame_rate_hz
        if rate_hz and expected_hz and not 1 / _OFF_RATE < rate_hz / expected_hz < _OFF_RATE:
            notes.append(
                f"frames come at {rate_hz:.4g} Hz, the yml says {expected_hz:g}: times of another unit?"
            )
        if band := values.get("bandwidth_hz", Value()).value:
            notes.append(
                "the band is measured in this recording: recordings that share curves need --bandwidth-hz "
                f"{band[0]:.4g} {band[1]:.4g}"
            )
        if said.kind == "IQ" and (heard := self._heard(values)) is not None:
            notes += _odd_centres(measured_centres_hz(*heard), heard[2])
        if settings.vector_pitch_mm and round(self.place.elements_per_line, 3) != 1:
            element_mm = settings.vector_pitch_mm / self.place.elements_per_line
            notes.append(
                f"lines are {self.place.elements_per_line:.4g} elements apart: {settings.vector_pitch_mm:g} "
                "mm "
                f"between lines is an element pitch of {element_mm:.4g} mm; if {settings.vector_pitch_mm:g} "
                "mm is "
                "that of the data sheet, give --element-pitch-mm"
            )
        own_mm, given_mm = said.element_pitch_mm, settings.element_pitch_mm
        if own_mm and given_mm and abs(given_mm - own_mm) > 1e-6 * own_mm:
            notes.append(f"element pitch {given_mm:.4g} mm as given, {own_mm:.4g} mm in its yml")
        if settings.probe and said.probe and probe_name(said, None) != probe_name(said, settings.probe):
            notes.append(f"probe {settings.probe} as given, {printable(said.probe)} in its yml")
        if (receive := said.receive) is not None and self._turns(values) is not None:
            notes.append(
                f"demodulation frequency from its yml: {receive.shallow_hz / 1e6:g} to "
                f"{receive.deep_hz / 1e6:g} "
                f"MHz over {receive.filter_depth_mm:g} mm, turned to that of the line's middle"
            )
        if (gain := self._gain_words()).startswith("differs"):
            notes.append(f"gain {gain}")
        if self.files.is_cut:
            notes.append(_CUT)
        if self.sensor is not None:
            notes += self.sensor[0].remarks
            if self.sensor[1] is None:
                notes.append(
                    "the sensor's quaternion does not agree with gravity: the sweep has no orientation, "
                    "which "
                    f"`speckle3d imu orient {self.files.path} --into SWEEP.h5` finds"
                )
        return notes

    def rows(self) -> list[Row]:
        """Facts of the package, as far as they can be read."""
        rows: list[Row] = [("recording", printable(self.files.name) or "without a name", "")]
        for name, member in self.files.settings.items():
            try:
                rows += _described(name, read_description(member), self.files)
            except (InvalidInputError, FileError) as error:
                rows.append((f"{name}: fields", f"cannot be told: {error}", ""))
        with suppress(InvalidInputError, FileError):  # which is told where the sweep is
            others = ", ".join(name for name in self.files.raw if name != self.chosen) or "none"
            rows += [("sweep is made from", self.chosen, ""), ("other raw files", others, "")]
            if self.said.roi is not None:
                outside = "empty, left out" if self.is_padded else "not empty, kept"
                rows.append(("outside the region of interest", outside, ""))
            rows += [
                ("elements per line", f"{self.place.elements_per_line:.6g}", ""),
                ("first line at element", f"{self.place.first_element:g}, taken as the image's left", ""),
                ("gain by frame", self._gain_words(), ""),
            ]
        try:
            if self.sensor is not None:
                rows += imu.sensor_rows(*self.sensor)
        except (InvalidInputError, FileError) as error:
            rows.append(("sensor", f"cannot be told: {error}", ""))
        return rows

    def _gain_words(self) -> str:
        if self.curves is None:
            return "not told: taken as the same"
        if len(set(self.curves)) == 1:
            return "the same in all frames: left as it is"
        grey = self.said.kind == "envelope"
        undone = "left in the grey levels" if grey else "undone relative to the first frame"
        return f"differs between frames: {undone}"


def _odd_centres(centres: tuple[float, float] | None, transmit_hz: float) -> list[str]:
    """Tell centres of the echoes' spectrum, near the probe and far, that echoes of tissue cannot have."""
    if centres is None or not (
        centres[1] > _MOST_RISE * centres[0] or centres[0] > _MOST_ABOVE * transmit_hz
    ):
        return []
    near, far = (f"{centre / 1e6:.2f}" for centre in centres)
    return [
        f"the echoes' centre goes from {near} to {far} MHz with depth, {transmit_hz / 1e6:g} MHz were sent, "
        "and "
        "tissue takes high frequencies away: I/Q were shifted down otherwise than is said, Q has the other "
        "sign, "
        "or it is a harmonic image"
    ]


def _described(name: str, said: Description, files: Files) -> list[Row]:
    """Rows of what a yml says."""
    raw = files.raw.get(name)
    file = "none" if raw is None else "packed (.lzo)" if raw.name.endswith(".lzo") else "yes"
    first, last = said.receive_element[[0, -1]]
    rows: list[Row] = [
        (f"{name}: type", said.kind, ""),
        (f"{name}: raw file", file, ""),
        (f"{name}: frames", str(said.frames), ""),
        (f"{name}: lines x samples", f"{said.lines} x {said.samples}", f"of {said.sample_bytes} bytes"),
        (f"{name}: lines at elements", f"{first:g} to {last:g}", ""),
    ]
    for words, value, scale, unit in (
        ("sampling rate", said.sampling_rate_hz, 1e-6, "MHz"),
        ("delay of the first sample", said.delay_samples, 1.0, "samples"),
        ("frame rate", said.frame_rate_hz, 1.0, "frames/s"),
        ("transmit frequency", said.transmit_frequency_hz, 1e-6, "MHz"),
        ("imaging depth", said.imaging_depth_mm, 1.0, "mm"),
        ("speed of sound", said.speed_of_sound_m_s, 1.0, "m/s"),
    ):
        if value is not None:
            rows.append((f"{name}: {words}", f"{value * scale:g}", unit))
    if said.gain:
        rows.append((f"{name}: gain", ", ".join(f"{g:g} dB at {d:g} mm" for d, g in said.gain[:30]), ""))
    if (roi := said.roi) is not None:
        words = f"lines {roi.start_line} to {roi.end_line}, samples {roi.start_sample} to {roi.end_sample}"
        rows.append((f"{name}: region of interest", words, ""))
    if said.unused:
        rows.append((f"{name}: fields not read", printable(", ".join(said.unused)[:400]), ""))
    return rows
