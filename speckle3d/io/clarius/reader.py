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

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.io.clarius.imu import SensorSamples, read_samples
from speckle3d.io.clarius.package import SAMPLES, Description, find_files, is_package, open_frames, open_raw
from speckle3d.io.clarius.spectrum import band_hz
from speckle3d.io.frames import FileFrames
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Facts, Recording, Value, step_of

FORMAT = "Clarius raw package"

ELEMENT_PITCH_MM = {"L20HD3": 0.13, "L15HD3": 0.26, "L7HD3": 0.2, "PALHD3": 0.26}
"""Of the linear arrays in the maker's table of HD3 probes [2]_; of the PAL, its linear side."""

CONVEX = ("C3", "C7", "EC7", "PH", "PA2", "PA", "TV")
"""Models whose lines are not parallel."""

BEFORE_DEPTH_S = 1e-6
"""Delay that is not depth; see above."""

_FACTS = (
    "type", "frames", "frame rate", "sampling rate", "delay samples", "transmit frequency", "imaging depth",
    "vsound", "speed of sound",
)  # fmt: skip
_YML = "its yml"


def open_package(path: Path, settings: ImportSettings) -> Facts:
    """Read a package: RF is preferred, else I/Q, else the envelope. Times are of the scanner's clock."""
    name, raw, sidecars = find_files(path)
    yield "recording", name or "without a name", ""
    sensor, remarks = None, list[str]()
    if "imu" in sidecars:
        try:
            sensor = read_samples(sidecars["imu"])
            yield from sensor.rows
            remarks += sensor.remarks
        except Speckle3DError as error:
            remarks.append(f"the sensor is left out: {error}")
    ymls = {kind: Description.of(file) for kind, file in sidecars.items() if kind != "imu"}
    for kind, yml in ymls.items():
        facts = ((fact, yml.fields[fact]) for fact in _FACTS if yml.fields.get(fact))
        yield from ((f"{kind}: {fact}", str(text)[:60], "") for fact, text in facts)
    if (kinds := raw.keys() - ymls.keys()) or not raw:
        start, suffix = f"{name}_" if name else "", "yml" if kinds else "raw"
        lacks = " or ".join(f"{start}{kind}.{suffix}" for kind in sorted(kinds or ymls)) or "samples (.raw)"
        raise InvalidInputError(f"{path}: expected {lacks} beside the rest, got none")
    kind = min(raw, key=lambda kind: [*SAMPLES].index(ymls[kind].kind))
    yield "sweep is made from", kind, ""
    yml, member, signal = ymls[kind], raw[kind], ymls[kind].kind
    records = open_raw(member, signal)
    shape = records["samples"].shape[:3]
    elements = yml.elements(shape[1])
    yield "first line at element", f"{elements[0]:g}, taken as the image's left", ""
    if (count := yml.number("frames")) not in (None, len(records)):
        remarks.append(f"the yml says {count:g} frames, the raw file holds {len(records)}")

    yml_rate_hz, transmit_hz = yml.require("sampling rate"), yml.number("transmit frequency")
    if not yml_rate_hz > 0:
        raise InvalidInputError(f"{yml.where}: sampling rate: expected it above zero, got {yml_rate_hz:g}")
    rate_hz = settings.sampling_rate_hz or yml_rate_hz
    speed_m_s = yml.number("vsound") or yml.number("speed of sound")
    spacing_mm = 1e3 * (settings.speed_of_sound_m_s or speed_m_s or SPEED_OF_SOUND_M_S) / (2.0 * rate_hz)
    probe = settings.probe or yml.model
    first, model = Value(), re.sub(r"[^A-Z0-9]", "", probe.upper()).removeprefix("CLARIUS")
    if (delay := yml.number("delay samples")) is not None:
        first = Value(
            (delay - BEFORE_DEPTH_S * rate_hz) * spacing_mm,
            "delay samples, less 1 us before depth 0 (assumed)",
        )
        if first.value < 0:
            first = Value(
                0.0, f"assumed: the delay of {1e6 * delay / rate_hz:.2f} us is below the 1 us before depth 0"
            )
    values = {
        "first_sample_depth_mm": first,
        "row_spacing_mm": Value(spacing_mm, f"of {rate_hz / 1e6:g} MHz"),
        "sampling_rate_hz": Value(yml_rate_hz, _YML),
        "centre_frequency_hz": Value(transmit_hz, "transmit frequency"),
        **({"speed_of_sound_m_s": Value(speed_m_s, _YML)} if speed_m_s else {}),
        **_line_values(yml, elements, settings, model),
    }
    shift_hz, turns = None, None
    if signal == "IQ":
        shift_hz, receive = settings.demodulation_frequency_hz, yml.receive
        if receive is not None:
            start_mm = first.value or settings.first_sample_depth_mm or 0.0
            depths_mm = start_mm + spacing_mm * np.arange(shape[2], dtype=np.float64)
            middle_hz, slide = _oscillator(receive, depths_mm, rate_hz)
            values["demodulation_frequency_hz"] = Value(middle_hz, "of the lines' middle")
            if shift_hz is None and slide.any():
                turns = np.exp(2j * np.pi * slide)
                remarks.append(
                    f"demodulation frequency from its yml: {receive[0] / 1e6:g} to {receive[1] / 1e6:g} MHz "
                    f"over {receive[2]:g} mm, turned to that of the line's middle"
                )
            shift_hz = middle_hz if shift_hz is None else shift_hz
    narrow = np.int16 if signal == "IQ" and turns is None else None
    source = partial(open_frames, member, signal, turns)
    frames = FileFrames(member.path, source, shape, SAMPLES[signal][2], narrow)
    centre_hz = settings.centre_frequency_hz or transmit_hz
    band, has_spectrum = None, signal == "RF" or shift_hz is not None
    if settings.bandwidth_hz is None and centre_hz and has_spectrum:
        band = band_hz(frames, rate_hz, centre_hz, shift_hz)
    if band is not None:
        values["bandwidth_hz"] = Value(band, "measured at -6 dB in this recording")
        remarks.append(
            "the band is measured in this recording: recordings that share curves need "
            f"--bandwidth-hz {band[0]:.4g} {band[1]:.4g}"
        )
    return Recording(
        path,
        settings,
        frames,
        values,
        time_s=records["time"] / 1e9,
        orientation=None if sensor is None else sensor.orientation,
        # In one spelling, so that curves and calibrations of a probe are found to be of it.
        probe=f"Clarius {model}" if model in ELEMENT_PITCH_MM else probe,
        name=name or path.stem,
        substitutes=dict.fromkeys(
            ("vector_pitch_mm", "column_pitch_mm"), "element_pitch_mm" if model else "probe"
        ),
        assumptions=() if "array_radius_mm" in values else ("parallel lines of a linear array",),
        remarks=remarks,
    )


def sensor_of(path: Path) -> SensorSamples:
    """Read the sensor's samples of a package.

    Raises
    ------
    InvalidInputError
        If the package has no sensor, or its samples make no sense.
    """
    if (member := find_files(path)[2].get("imu")) is None:
        raise InvalidInputError(f"{path}: expected the sensor's samples (_imu.yml), got none")
    return read_samples(member)


def package_files(path: Path) -> Sequence[Path]:
    """Other files on disk that the sweep's content depends on."""
    _, raw, sidecars = find_files(path)
    return sorted({member.path for member in (*raw.values(), *sidecars.values())} - {path})


def _oscillator(
    receive: tuple[float, ...], depths_mm: FloatArray, rate_hz: float
) -> tuple[float, FloatArray]:
    """Demodulation frequency at the lines' middle, and turns of each sample that lead to it.

    The frequency falls along a straight line with depth, as from 11 to 8 MHz; a sweep has one. Samples are
    turned as if the oscillator had stayed at that of the line's middle, which takes its phase to be the
    integral of its frequency: so it is where a frequency is swept, but it is not documented. Left as they
    are, simulated I/Q shifted down by 9 to 6 MHz gave lengths 10 % off, and turned back 0.001 % from those
    of RF.
    """
    shallow_hz, deep_hz, filter_mm = receive
    oscillator_hz = np.interp(depths_mm, [0.0, filter_mm], [shallow_hz, deep_hz])
    middle_hz = float(np.interp(depths_mm[[0, -1]].mean(), depths_mm, oscillator_hz))
    return middle_hz, cumulative_trapezoid(oscillator_hz - middle_hz, initial=0) / rate_hz


def _line_values(
    yml: Description, elements: FloatArray, settings: ImportSettings, model: str
) -> dict[str, Value]:
    """Distance between lines at the array, by the element pitch of the option, the yml or the table.

    Of a curved array its radius and the lines' angles, too, without values where they are not known.
    """
    per_line = step_of(elements, f"{yml.where}: lines (packets of a Doppler mode are no image): rx element")
    pitches = {
        "as given": settings.element_pitch_mm,
        _YML: yml.number("probe", "pitch"),
        f"the maker's table, {model}": ELEMENT_PITCH_MM.get(model),
    }
    pitch = Value(settings.vector_pitch_mm, "--vector-pitch-mm")  # also between columns of an envelope
    for source, element_mm in reversed(pitches.items()):
        if element_mm is not None:
            words = f"{per_line:g} elements a line (yml) x {element_mm:g} mm ({source})"
            pitch = Value(element_mm * per_line, words)
    values = {"vector_pitch_mm": pitch}
    radius_mm, count = yml.number("probe", "radius"), yml.number("probe", "elements")
    if radius_mm or model.startswith(CONVEX):
        values |= {"array_radius_mm": Value(radius_mm, _YML), "line_angles_deg": Value()}
    if radius_mm and pitch.value is not None:
        ends = elements[[0, -1]] - ((count - 1) / 2 if count else elements.mean())
        degrees = np.rad2deg(ends * pitch.value / per_line / radius_mm)
        values["line_angles_deg"] = Value(tuple(degrees.tolist()), f"of lines {pitch.source}")
    return values


READER = Reader(FORMAT, is_package, open_package, companions=package_files)
