"""Sweeps from Clarius raw packages: one object, read once, that says what the files do."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ComplexArray, FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.printable import printable
from speckle3d.io.clarius.imu import SensorSamples, read_samples
from speckle3d.io.clarius.lines import differing, element_pitches, first_depth_mm, place_of, probe_name
from speckle3d.io.clarius.package import Files, find_files
from speckle3d.io.clarius.raw import ClariusFile, Gain, read_header
from speckle3d.io.clarius.sidecars import Curve, Description, read_description, read_gains
from speckle3d.io.clarius.spectrum import Echoes
from speckle3d.io.frames import FileFrames
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings
from speckle3d.io.recordings import Recording, Row, Value

FORMAT = "Clarius raw package"

_ORDER = ("RF", "IQ", "envelope")
_SAID = (
    "type", "frames", "frame rate", "sampling rate", "delay samples", "transmit frequency", "imaging depth",
    "vsound", "speed of sound",
)  # fmt: skip
_MOST_RISE, _MOST_ABOVE = 1.05, 1.15
"""Of the echoes' centre: far from the probe over near, and near over what was sent. On a simulated phantom
0.91 and 0.79; with the other sign of Q 1.05 and 1.22; with another phase of a falling oscillator 1.16 and
0.87."""
_SAME_DB = 0.005
"""Gains are written to 0.01 dB."""
_DEPTH = 0.1
"""Share by which the samples may miss the imaging depth untold: 1.3 % in every recording at hand."""


def open_package(path: Path, settings: ImportSettings) -> Recording:
    """Read a package: RF is preferred, else I/Q, else the envelope. Times are of the scanner's clock."""
    package = Package(find_files(path), settings)
    return Recording.of(path, settings, package.rows(), package.recording)


def sensor_of(path: Path) -> SensorSamples:
    """Read the sensor's samples of a package.

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
    return sorted({member.path for member in find_files(path).members.values()} - {path})


class Package:
    """A package and the settings over it; each of its files is read once, when it is needed."""

    def __init__(self, files: Files, settings: ImportSettings) -> None:
        self.files, self.settings = files, settings
        self.raw, self.gains = files.of("raw"), files.of("tgc")

    @cached_property
    def descriptions(self) -> dict[str, Description]:
        """What the yml files say, by kind."""
        members = self.files.of("yml")
        return {kind: read_description(member) for kind, member in members.items() if kind != "imu"}

    @cached_property
    def chosen(self) -> str:
        """Kind of the raw file that becomes the sweep."""
        if not self.raw:
            raise InvalidInputError(
                f"{self.files.path}: expected a raw file (as {self.files.name}_rf.raw), got sidecars alone: "
                "they describe frames that are not there"
            )
        for kind, member in self.raw.items():
            if kind not in self.descriptions:
                raise InvalidInputError(f"{member.where}: expected its yml beside it, got none")
        return min(self.raw, key=lambda kind: _ORDER.index(self.descriptions[kind].kind))

    @property
    def said(self) -> Description:
        """What the yml of the sweep's raw file says."""
        return self.descriptions[self.chosen]

    @cached_property
    def header(self) -> tuple[ClariusFile, npt.NDArray[np.int64]]:
        """The raw file, and times of its frames in nanoseconds."""
        return read_header(self.raw[self.chosen], self.said)

    @cached_property
    def sensor(self) -> SensorSamples | None:
        """The sensor's samples."""
        member = self.files.members.get(("imu", "yml"))
        return None if member is None else read_samples(member)

    @cached_property
    def is_padded(self) -> bool:
        """Whether what lies outside the region of interest is empty, in the first, middle and last frame."""
        file = self.header[0]
        if self.said.roi is None:
            return False
        for i in {0, file.frames // 2, file.frames - 1}:
            frame = np.array(file()(i))
            frame[self.said.roi] = 0
            if frame.any():
                return False
        return True

    @cached_property
    def kept(self) -> tuple[slice, slice]:
        """Lines and samples that are kept."""
        whole = slice(0, self.said.lines), slice(0, self.said.samples)
        return self.said.roi if self.said.roi and self.is_padded else whole

    @cached_property
    def place(self) -> tuple[float, float]:
        """Place of the first line, and the distance between lines, in elements."""
        try:
            return place_of(self.said, self.kept[0])
        except InvalidInputError as error:
            others = [member.name for kind, member in self.raw.items() if kind != self.chosen]
            if not others:
                raise
            raise InvalidInputError(
                f"{error}; or give another of its raw files: {', '.join(others)}"
            ) from error

    @cached_property
    def file(self) -> ClariusFile:
        """The kept part of the raw file."""
        return replace(self.header[0], kept=self.kept, turns=self.turns)

    @cached_property
    def rate_hz(self) -> float:
        """Sampling rate."""
        return self.settings.sampling_rate_hz or self.said.fields.number("sampling rate", "Hz", 1.0)

    @cached_property
    def speed_m_s(self) -> float | None:
        """Speed of sound that the yml says."""
        said = self.said.fields
        return said.optional("vsound", "m/s") or said.optional("speed of sound", "m/s")

    @cached_property
    def spacing_mm(self) -> float:
        """Distance between samples."""
        speed = self.settings.speed_of_sound_m_s or self.speed_m_s or SPEED_OF_SOUND_M_S
        return 1e3 * speed / (2.0 * self.rate_hz)

    @cached_property
    def first_mm(self) -> float | None:
        """Depth of the first kept sample as the scanner counts it."""
        return first_depth_mm(self.said, self.kept[1].start, self.rate_hz, self.spacing_mm)

    @cached_property
    def depths_mm(self) -> FloatArray:
        """Depth of each kept sample as the scanner counts it, or else as it is given."""
        most_mm = self.said.fields.optional("imaging depth", "mm") or np.inf
        first_mm = self.first_mm
        if first_mm is None or first_mm > most_mm:
            first_mm = self.settings.first_sample_depth_mm or 0.0
        count = self.kept[1].stop - self.kept[1].start
        return np.asarray(first_mm + np.arange(count) * self.spacing_mm)

    @cached_property
    def shift_hz(self) -> float | None:
        """Frequency that I/Q were shifted down by in the lines' middle; None of RF, or where not said."""
        if self.said.kind != "IQ" or self.said.receive is None:
            return None
        return float(self.said.receive.at_hz(float(self.depths_mm[0] + self.depths_mm[-1]) / 2))

    @cached_property
    def turns(self) -> ComplexArray | None:
        """Factors that make I/Q as if shifted down by one frequency, shape (sample,); None where they are.

        The scanner's demodulation frequency falls along a straight line with depth, as from 11 to 8 MHz; a
        sweep has one. Samples are turned as if the oscillator had stayed at that of the line's middle, which
        takes the oscillator's phase to be the integral of its frequency: so it is where a frequency is swept,
        but it is not documented. Left as they are, simulated I/Q shifted down by 9 to 6 MHz gave lengths 10 %
        off, and turned back 0.001 % from those of RF.
        """
        receive = self.said.receive
        is_one = receive is None or receive.shallow_hz == receive.deep_hz
        if (
            receive is None
            or self.shift_hz is None
            or is_one
            or self.settings.demodulation_frequency_hz is not None
        ):
            return None
        apart = receive.at_hz(self.depths_mm) - self.shift_hz
        cycles = np.concatenate([[0.0], np.cumsum((apart[1:] + apart[:-1]) / 2)]) / self.rate_hz
        return np.asarray(np.exp(2j * np.pi * cycles))

    @cached_property
    def echoes(self) -> Echoes | None:
        """Spectrum of the echoes; None of an envelope, and where frequencies are not known."""
        given = self.settings
        centre = given.centre_frequency_hz or self.said.fields.optional("transmit frequency", "Hz")
        is_iq = self.said.kind == "IQ"
        shift = self.shift_hz if given.demodulation_frequency_hz is None else given.demodulation_frequency_hz
        if self.said.kind == "envelope" or not centre or (is_iq and shift is None):
            return None
        frames = FileFrames(self.files.path, self.file, self.file.shape, self.file.dtype)
        return Echoes(frames, self.rate_hz, centre, shift if is_iq else None)

    @cached_property
    def curves(self) -> tuple[Curve, ...]:
        """Gain curve of each frame; empty where the package does not tell.

        The gain file of another kind of the same recording serves too: all kinds see the same analogue gain
        (answers of the maker in clariusdev/research).
        """
        times_ns = self.header[1].tolist()
        for kind, member in sorted(self.gains.items(), key=lambda one: one[0] != self.chosen):
            curves = read_gains(member)
            lacking = [time_ns for time_ns in times_ns if time_ns not in curves]
            if curves and not lacking:
                return tuple(curves[time_ns] or self.said.gain for time_ns in times_ns)
            if curves and kind == self.chosen:
                raise InvalidInputError(
                    f"{member.where}: expected the gain of the frame at {lacking[0]} ns, got none "
                    f"({len(lacking)} of {len(times_ns)} frames)"
                )
        return ()

    @cached_property
    def gain(self) -> Gain | None:
        """Gain to undo relative to the first frame; None where it is the same, or of an envelope."""
        if len(set(self.curves)) < 2 or self.said.kind == "envelope":
            return None
        if () in self.curves:
            where = f"{self.said.fields.where}: frame {self.curves.index(())}"
            raise InvalidInputError(f"{where}: expected a gain curve as other frames have, got none")
        gain = Gain(self.depths_mm, self.curves)
        firsts = {curve: i for i, curve in reversed(list(enumerate(self.curves)))}.values()
        off_db = max(np.abs(20 * np.log10(gain.factors(i))).max() for i in firsts)
        return gain if off_db >= _SAME_DB else None

    def recording(self) -> Recording:
        """What the package holds, as a recording."""
        said, own, file = self.said, "its yml", replace(self.file, gain=self.gain)
        fields, per_line = said.fields, self.place[1]
        pitches = element_pitches(said, self.settings, per_line)
        pitch = Value()
        for source, element_mm in list(pitches.items())[:1]:
            pitch = Value(
                element_mm * per_line,
                f"{per_line:g} elements a line (yml) x {element_mm:g} mm ({source})",
                own,
            )
        delay = "delay samples, less 1 us before depth 0 (assumed)"
        values = {
            "first_sample_depth_mm": Value(self.first_mm, delay, own),
            "vector_pitch_mm": pitch,
            "column_pitch_mm": pitch,
            "row_spacing_mm": Value(self.spacing_mm, f"of {self.rate_hz / 1e6:g} MHz", own),
            "sampling_rate_hz": Value(fields.number("sampling rate", "Hz", 1.0), "", own),
            "centre_frequency_hz": Value(
                fields.optional("transmit frequency", "Hz"), "transmit frequency", own
            ),
            "demodulation_frequency_hz": Value(self.shift_hz, "of the lines' middle", own),
        }
        if self.speed_m_s is not None:
            values["speed_of_sound_m_s"] = Value(self.speed_m_s, "", own)
        remarks = [*differing(pitches), *self._remarks()]
        if self.echoes is not None and self.settings.bandwidth_hz is None:
            band = self.echoes.band_hz
            values["bandwidth_hz"] = Value(band, "measured at -6 dB in this recording", "the spectrum")
            if band is not None:
                remarks.append(
                    "the band is measured in this recording: recordings that share curves need "
                    f"--bandwidth-hz {band[0]:.4g} {band[1]:.4g}"
                )
        is_plain = file.turns is None and file.gain is None
        narrow = np.int16 if said.kind == "IQ" and is_plain else None
        asked = "element_pitch_mm" if self.settings.probe or said.probe else "probe"
        return Recording(
            self.files.path,
            self.settings,
            FileFrames(self.raw[self.chosen].path, file, file.shape, file.dtype, narrow),
            values,
            time_s=self.header[1] / 1e9,
            orientation=None if self.sensor is None else self.sensor.orientation,
            probe=probe_name(said, self.settings.probe),
            name=self.files.name or self.files.path.stem,
            asked=dict.fromkeys(("vector_pitch_mm", "column_pitch_mm"), asked),
            assumptions=("parallel lines of a linear array",),
            remarks=tuple(remarks),
        )

    def _remarks(self) -> list[str]:
        """What was turned, undone or is odd where the sweep is made."""
        said, given, notes = self.said, self.settings, list[str]()
        depth_mm = said.fields.optional("imaging depth", "mm")
        first_mm = (
            given.first_sample_depth_mm if given.first_sample_depth_mm is not None else self.first_mm or 0.0
        )
        start = first_mm - self.kept[1].start * self.spacing_mm
        low_mm, high_mm = (start + count * self.spacing_mm for count in (
            said.roi[1].stop if said.roi else said.samples, said.samples))  # fmt: skip
        if depth_mm and not (low_mm <= (1 + _DEPTH) * depth_mm and high_mm >= (1 - _DEPTH) * depth_mm):
            notes.append(
                f"the samples reach {high_mm:.4g} mm, and the imaging depth in the yml is {depth_mm:g} mm: "
                "the region of interest is another, or the sampling rate"
            )
        per_line = self.place[1]
        if given.vector_pitch_mm and round(per_line, 3) != 1:
            notes.append(
                f"lines are {per_line:.4g} elements apart: {given.vector_pitch_mm:g} mm between lines is an "
                f"element pitch of {given.vector_pitch_mm / per_line:.4g} mm; if the first is that of the "
                "data sheet, give --element-pitch-mm"
            )
        if given.probe and said.probe and probe_name(said, None) != probe_name(said, given.probe):
            notes.append(f"probe {given.probe} as given, {printable(said.probe)} in its yml")
        if (receive := said.receive) is not None and self.turns is not None:
            notes.append(
                f"demodulation frequency from its yml: {receive.shallow_hz / 1e6:g} to "
                f"{receive.deep_hz / 1e6:g} MHz over {receive.filter_depth_mm:g} mm, turned to that of the "
                "line's middle"
            )
        if len(set(self.curves)) > 1:
            notes.append(self._gain_words())
        if said.kind == "IQ" and self.echoes is not None and (centres := self.echoes.centres_hz) is not None:
            near, far = centres
            if far > _MOST_RISE * near or near > _MOST_ABOVE * self.echoes.transmit_hz:
                notes.append(
                    f"the echoes' centre goes from {near / 1e6:.2f} to {far / 1e6:.2f} MHz with depth, "
                    f"{self.echoes.transmit_hz / 1e6:g} MHz were sent, and tissue takes high frequencies "
                    "away: I/Q were shifted down otherwise than is said, Q has the other sign, or it is a "
                    "harmonic image"
                )
        if self.sensor is not None:
            notes += self.sensor.remarks
            if self.sensor.fit is None:
                why = "is missing" if self.sensor.quaternion is None else "does not agree with gravity"
                notes.append(
                    f"the sensor's quaternion {why}: the sweep has no orientation, "
                    f"which `speckle3d imu orient {self.files.path} --into SWEEP.h5` finds"
                )
        return notes

    def _gain_words(self) -> str:
        if len(set(self.curves)) < 2:
            return "gain the same in all frames" if self.curves else "gain not told: taken as the same"
        undone = (
            "left in the grey levels"
            if self.said.kind == "envelope"
            else "undone relative to the first frame"
        )
        return f"gain differs between frames: {undone}"

    def rows(self) -> list[Row]:
        """Facts of the package, as far as they can be read."""
        rows: list[Row] = [("recording", printable(self.files.name) or "without a name", "")]
        with suppress(InvalidInputError, FileError):  # which is told where the sweep is
            for kind, said in self.descriptions.items():
                rows.append((f"{kind}: raw file", "yes" if kind in self.raw else "none", ""))
                rows += [
                    (f"{kind}: {name}", printable(str(said.fields.values[name]))[:60], "")
                    for name in _SAID
                    if name in said.fields.values
                ]
                rows.append((f"{kind}: lines x samples", f"{said.lines} x {said.samples}", ""))
            rows.append(("sweep is made from", self.chosen, ""))
            if self.said.roi is not None:
                outside = "empty, left out" if self.is_padded else "not empty, kept"
                rows.append(("outside the region of interest", outside, ""))
            rows += [
                ("elements per line", f"{self.place[1]:.6g}", ""),
                ("first line at element", f"{self.place[0]:g}, taken as the image's left", ""),
                ("gain by frame", self._gain_words(), ""),
            ]
        try:
            rows += [] if self.sensor is None else self.sensor.rows()
        except (InvalidInputError, FileError) as error:
            rows.append(("sensor", f"cannot be told: {error}", ""))
        return rows
