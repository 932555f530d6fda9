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
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ComplexArray, FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.printable import printable
from speckle3d.io.clarius.imu import SensorSamples, read_samples
from speckle3d.io.clarius.package import Files, find_files
from speckle3d.io.clarius.raw import ClariusFile, read_header
from speckle3d.io.clarius.sidecars import Description, read_gains
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
        self.files, self.settings, self.raw = files, settings, files.of("raw")

    @cached_property
    def descriptions(self) -> dict[str, Description]:
        """What the yml files say, by kind."""
        members = self.files.of("yml")
        return {kind: Description.of(member) for kind, member in members.items() if kind != "imu"}

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

    @cached_property
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
    def kept(self) -> tuple[slice, slice]:
        """Lines and samples kept: the region of interest, if there is nothing beside it in three frames."""
        whole, region = (slice(0, self.said.lines), slice(0, self.said.samples)), self.said.region
        if region is None:
            return whole
        file = self.header[0]
        for i in {0, file.frames // 2, file.frames - 1}:
            frame = np.array(file()(i))
            frame[region] = 0
            if frame.any():
                return whole
        return region

    @cached_property
    def place(self) -> tuple[float, float]:
        """Place of the first kept line in the array, and the distance between lines, in elements.

        Raises
        ------
        InvalidInputError
            Naming the line that is steered, unevenly spaced or repeated.
        """
        said = self.said
        others = [member.name for kind, member in self.raw.items() if kind != self.chosen]
        advice = f"; or give another of its raw files: {', '.join(others)}" if others else ""
        elements, angle_deg = said.places.T
        if (steered := np.flatnonzero(angle_deg)).size:
            i = int(steered[0])
            raise InvalidInputError(
                f"{said.where}: lines[{i}]: angle: expected 0 (lines that are not steered), got "
                f"{angle_deg[i]:g} deg, and {steered.size} of {said.lines} lines steered: record without "
                f"steering and Doppler{advice}"
            )
        elements = elements[self.kept[0]]
        try:
            return float(elements[0]), step_of(elements, f"{said.where}: lines, rx element")
        except InvalidInputError as error:
            raise InvalidInputError(f"{error}: packets of a Doppler mode are no image{advice}") from error

    @cached_property
    def pitch(self) -> Value:
        """Distance between lines at the array, mm: of the elements' as given, by the yml, or a table's."""
        per_line, model = self.place[1], _model(self.settings.probe or self.said.probe)
        pitches = {
            "as given": self.settings.element_pitch_mm,
            _OWN: self.said.of_probe("pitch"),
            f"the maker's table, {model}": ELEMENT_PITCH_MM.get(model),
        }
        for source, element_mm in pitches.items():
            if element_mm is not None:
                words = f"{per_line:g} elements a line (yml) x {element_mm:g} mm ({source})"
                return Value(element_mm * per_line, words, _OWN)
        return Value(self.settings.vector_pitch_mm, "--vector-pitch-mm")

    @cached_property
    def spreading(self) -> dict[str, Value]:
        """Where the lines of a curved array lie; of a curved model without its radius, that it is lacking."""
        radius_mm, named = self.said.of_probe("radius"), self.settings.probe or self.said.probe
        if not radius_mm and not _model(named).startswith(CONVEX):
            return {}
        step_mm, lines = self.pitch.value, self.kept[0]
        values = {"array_radius_mm": Value(radius_mm, "", _OWN), "line_angles_deg": Value()}
        if radius_mm and step_mm is not None:
            elements = self.said.below("probe").optional("elements")
            first = -(len(self.said.places[lines]) - 1) / 2 * step_mm
            if elements:
                first = (self.place[0] - (elements - 1) / 2) * step_mm / self.place[1]
            last = first + (len(self.said.places[lines]) - 1) * step_mm
            angles = tuple(np.rad2deg([first / radius_mm, last / radius_mm]).tolist())
            values["line_angles_deg"] = Value(angles, f"of lines {self.pitch.source}", _OWN)
        return values

    @cached_property
    def file(self) -> ClariusFile:
        """The kept part of the raw file."""
        return replace(self.header[0], kept=self.kept, turns=self.turns)

    @cached_property
    def rate_hz(self) -> float:
        """Sampling rate."""
        return self.settings.sampling_rate_hz or self.said.number("sampling rate", "Hz", 1.0)

    @cached_property
    def speed_m_s(self) -> float | None:
        """Speed of sound that the yml says."""
        return self.said.optional("vsound", "m/s") or self.said.optional("speed of sound", "m/s")

    @cached_property
    def spacing_mm(self) -> float:
        """Distance between samples."""
        speed = self.settings.speed_of_sound_m_s or self.speed_m_s or SPEED_OF_SOUND_M_S
        return 1e3 * speed / (2.0 * self.rate_hz)

    @cached_property
    def first_mm(self) -> float | None:
        """Depth of the first kept sample as the scanner counts it; None where it is not said, or above 0.

        Less than a sample above is 0: the delay is a whole number of samples.
        """
        if (delay := self.said.optional("delay samples")) is None:
            return None
        after = delay + self.kept[1].start - BEFORE_DEPTH_S * self.rate_hz
        return max(after, 0.0) * self.spacing_mm if after > -1.0 else None

    @cached_property
    def depths_mm(self) -> FloatArray:
        """Depth of each kept sample as the scanner counts it, or else as it is given."""
        most_mm, first_mm = self.said.optional("imaging depth", "mm") or np.inf, self.first_mm
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
        receive, shift = self.said.receive, self.shift_hz
        if receive is None or shift is None or receive.shallow_hz == receive.deep_hz:
            return None
        if self.settings.demodulation_frequency_hz is not None:
            return None
        apart = receive.at_hz(self.depths_mm) - shift
        cycles = np.concatenate([[0.0], np.cumsum((apart[1:] + apart[:-1]) / 2)]) / self.rate_hz
        return np.asarray(np.exp(2j * np.pi * cycles))

    @cached_property
    def band_hz(self) -> tuple[float, float] | None:
        """Band of the echoes; None of an envelope, where frequencies are not known, or if it is not clear."""
        given, is_iq = self.settings, self.said.kind == "IQ"
        centre = given.centre_frequency_hz or self.said.optional("transmit frequency", "Hz")
        shift = self.shift_hz if given.demodulation_frequency_hz is None else given.demodulation_frequency_hz
        if self.said.kind == "envelope" or not centre or (is_iq and shift is None):
            return None
        frames = FileFrames(self.files.path, self.file, self.file.shape, self.file.dtype)
        return band_hz(frames, self.rate_hz, centre, shift if is_iq else None)

    @cached_property
    def gain_words(self) -> str:
        """Whether all frames have one gain, by the files that tell: kinds see the same analogue gain."""
        gains = {tuple(read_gains(member)) for member in self.files.of("tgc").values()}
        if len({gain for of_frames in gains for gain in of_frames}) > 1:
            return "gain differs between frames: left as it is, as patches are compared whatever their gain"
        return "gain the same in all frames" if any(gains) else "gain not told: taken as the same"

    def recording(self) -> Recording:
        """What the package holds, as a recording."""
        said, pitch, file = self.said, self.pitch, self.file
        delay = "delay samples, less 1 us before depth 0 (assumed)"
        centre_hz = said.optional("transmit frequency", "Hz")
        values = {
            "first_sample_depth_mm": Value(self.first_mm, delay, _OWN),
            "vector_pitch_mm": pitch,
            "row_spacing_mm": Value(self.spacing_mm, f"of {self.rate_hz / 1e6:g} MHz", _OWN),
            "sampling_rate_hz": Value(said.number("sampling rate", "Hz", 1.0), "", _OWN),
            "centre_frequency_hz": Value(centre_hz, "transmit frequency", _OWN),
            "demodulation_frequency_hz": Value(self.shift_hz, "of the lines' middle", _OWN),
        }
        values |= self.spreading
        if self.speed_m_s is not None:
            values["speed_of_sound_m_s"] = Value(self.speed_m_s, "", _OWN)
        remarks = self._remarks()
        if self.settings.bandwidth_hz is None and (band := self.band_hz) is not None:
            words = "measured at -6 dB in this recording"
            values["bandwidth_hz"] = Value(band, words, "the spectrum")
            remarks.append(
                "the band is measured in this recording: recordings that share curves need "
                f"--bandwidth-hz {band[0]:.4g} {band[1]:.4g}"
            )
        narrow = np.int16 if said.kind == "IQ" and file.turns is None else None
        asked = "element_pitch_mm" if self.settings.probe or said.probe else "probe"
        return Recording(
            self.files.path,
            self.settings,
            FileFrames(self.raw[self.chosen].path, file, file.shape, file.dtype, narrow),
            values,
            time_s=self.header[1] / 1e9,
            orientation=None if self.sensor is None else self.sensor.orientation,
            probe=_probe_name(self.settings.probe or said.probe),
            name=self.files.name or self.files.path.stem,
            asked=dict.fromkeys(("vector_pitch_mm", "column_pitch_mm"), asked),
            assumptions=() if self.spreading else ("parallel lines of a linear array",),
            remarks=tuple(remarks),
        )

    def _remarks(self) -> list[str]:
        """What was turned, undone or is odd where the sweep is made."""
        said, notes = self.said, list[str]()
        if (receive := said.receive) is not None and self.turns is not None:
            notes.append(
                f"demodulation frequency from its yml: {receive.shallow_hz / 1e6:g} to "
                f"{receive.deep_hz / 1e6:g} MHz over {receive.filter_depth_mm:g} mm, turned to that of the "
                "line's middle"
            )
        if "differs" in self.gain_words:
            notes.append(self.gain_words)
        if self.sensor is not None:
            notes += self.sensor.remarks
            if self.sensor.fit is None:
                why = "is missing" if self.sensor.quaternion is None else "does not agree with gravity"
                notes.append(
                    f"the sensor's quaternion {why}: the sweep has no orientation, "
                    f"which `speckle3d imu orient {self.files.path} --into SWEEP.h5` finds"
                )
        return notes

    def rows(self) -> list[Row]:
        """Facts of the package, as far as they can be read."""
        rows: list[Row] = [("recording", printable(self.files.name) or "without a name", "")]
        with suppress(InvalidInputError, FileError):  # which is told where the sweep is
            for kind, said in self.descriptions.items():
                rows.append((f"{kind}: raw file", "yes" if kind in self.raw else "none", ""))
                held = [name for name in _SAID if name in said.values]
                rows += [(f"{kind}: {name}", printable(str(said.values[name]))[:60], "") for name in held]
                rows.append((f"{kind}: lines x samples", f"{said.lines} x {said.samples}", ""))
            rows.append(("sweep is made from", self.chosen, ""))
            if (region := self.said.region) is not None:
                outside = "empty, left out" if self.kept == region else "not empty, kept"
                rows.append(("outside the region of interest", outside, ""))
            rows += [
                ("elements per line", f"{self.place[1]:.6g}", ""),
                ("first line at element", f"{self.place[0]:g}, taken as the image's left", ""),
                ("gain by frame", self.gain_words, ""),
            ]
        try:
            rows += [] if self.sensor is None else self.sensor.rows()
        except (InvalidInputError, FileError) as error:
            rows.append(("sensor", f"cannot be told: {error}", ""))
        return rows


def _model(named: str) -> str:
    return re.sub(r"[^A-Z0-9]", "", named.upper()).removeprefix("CLARIUS")


def _probe_name(named: str) -> str:
    """Name a probe in one spelling, so that curves and calibrations of it are found to be of it."""
    return f"Clarius {_model(named)}" if _model(named) in ELEMENT_PITCH_MM else named
