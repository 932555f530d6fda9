"""What a Clarius package says, and where each number of its sweep is from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.printable import printable
from speckle3d.io.clarius import imu
from speckle3d.io.clarius.checks import depth_notes
from speckle3d.io.clarius.lines import Place, pitch_of, place_of, probe_name
from speckle3d.io.clarius.package import KINDS, Recording, find_recording
from speckle3d.io.clarius.reader import (
    Chosen,
    centres_of,
    choose,
    curves_of,
    is_padded,
    orientation_of,
    signal_values,
)
from speckle3d.io.clarius.sidecars import Description, read_description
from speckle3d.io.found import Found, contradictions
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings
from speckle3d.io.readers import Row

_MOST_RISE, _MOST_ABOVE = 1.05, 1.15
"""Of the echoes' centre: far from the probe over near, and near over what was sent. On a simulated phantom
0.91 and 0.79; with the other sign of Q 1.05 and 1.22; with another phase of a falling oscillator 1.16 and
0.87."""

_CUT = (
    "the tar file ends without the blocks that close one: it may be truncated, and files missing, as the "
    "sensor's"
)
_MOST_SHOWN = 30
"""Fields that are not read, and knots of a gain curve."""


def describe_package(path: Path, settings: ImportSettings) -> list[Row]:
    """Tell what a package holds, also where it is no sweep."""
    recording = find_recording(path)
    rows: list[Row] = [("recording", printable(recording.name) or "without a name", "")]
    if recording.cut:
        rows.append(("note", _CUT, ""))
    for name in KINDS:
        if name in recording.settings:
            rows += _told(f"{name}: fields", partial(_said_rows, recording, name))
    if recording.raw:
        rows += _chosen_rows(recording, settings)
    if recording.sensor is not None:
        rows += _told("sensor", lambda: _sensor_rows(recording))
    with suppress(InvalidInputError):  # told above, and where the sweep is
        rows += _covered_rows(recording)
    with suppress(InvalidInputError):
        told = {row[1] for row in rows if row[0] == "note"}
        rows += [("note", each, "") for each in package_notes(path, settings) if each not in told]
    return rows


def _told(what: str, rows: Callable[[], list[Row]]) -> list[Row]:
    """Rows of a part, or why there are none; the other parts keep theirs."""
    try:
        return rows()
    except (InvalidInputError, FileError) as error:
        return [(what, f"cannot be told: {error}", "")]


def package_notes(path: Path, settings: ImportSettings) -> Sequence[str]:
    """Tell what was measured, assumed or left out where the sweep was made."""
    recording = find_recording(path)
    chosen = choose(recording)
    place = place_of(chosen.said, is_padded(chosen))
    notes = depth_notes(chosen.said, settings)
    band = None if chosen.said.kind == "envelope" else signal_values(chosen, place, settings)["bandwidth_hz"]
    if band is not None and settings.bandwidth_hz is None:
        low, high = (f"{edge:.4g}" for edge in band)
        notes.append(
            f"the band is measured in this recording: recordings that share curves need --bandwidth-hz {low} "
            f"{high}"
        )
    if chosen.said.kind == "IQ":
        centres = centres_of(chosen, place, settings)
        transmit_hz = settings.centre_frequency_hz or chosen.said.transmit_frequency_hz
        if centres is not None and transmit_hz and _is_odd(*centres, transmit_hz):
            near, far = (f"{each / 1e6:.2f}" for each in centres)
            notes.append(
                f"the echoes' centre goes from {near} to {far} MHz with depth, {transmit_hz / 1e6:g} MHz "
                "were sent, and tissue takes high frequencies away: I/Q were shifted down otherwise than is "
                "said, Q has the other sign, or it is a harmonic image"
            )
    notes += _pitch_notes(chosen.said, place, settings)
    notes += contradictions(path, _said_by_yml(chosen.said, place), settings)
    source = _shift_source(chosen.said, settings)
    if chosen.said.kind == "IQ" and "turned" in source:
        notes.append(f"demodulation frequency from {source}")
    gain = _gain_said(recording, chosen)
    if gain.startswith("differs"):
        notes.append(f"gain {gain}")
    if recording.cut:
        notes.append(_CUT)
    if recording.sensor is not None:
        notes += imu.sensor_notes(imu.read_samples(recording.sensor))
    if recording.sensor is not None and orientation_of(recording) is None:
        notes.append(
            "the sensor's quaternion fits none of its other readings: the sweep has no orientation, which "
            f"`speckle3d imu orient {path} --into SWEEP.h5` finds"
        )
    return notes


def _said_by_yml(said: Description, place: Place) -> dict[str, Found]:
    """Numbers of the yml that options replace."""
    speed = said.speed_of_sound_m_s or SPEED_OF_SOUND_M_S
    own = {
        "sampling_rate_hz": said.sampling_rate_hz,
        "speed_of_sound_m_s": said.speed_of_sound_m_s,
        "first_sample_depth_mm": place.first_depth_mm(said.sampling_rate_hz, speed),
    }
    if said.kind != "envelope":
        own["centre_frequency_hz"] = said.transmit_frequency_hz
    return {name: Found(value, said_by="its yml") for name, value in own.items()}


def _sensor_rows(recording: Recording) -> list[Row]:
    if recording.sensor is None:
        return []
    samples = imu.read_samples(recording.sensor)
    notes: list[Row] = [("note", each, "") for each in imu.sensor_notes(samples)]
    return [*imu.sensor_rows(samples, imu.fits_of(samples)), *notes]


def _count(samples: float | None) -> tuple[str, str]:
    return ("not said", "") if samples is None else (f"{samples:g}", "samples")


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
        (f"{name}: delay of the first sample", *_count(said.delay_samples)),
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
        knots = (f"{g:g} dB at {d:g} mm" for d, g in said.gain[:_MOST_SHOWN])
        rows.append((f"{name}: gain", ", ".join(knots), ""))
    if said.roi is not None:
        roi = said.roi
        where = f"lines {roi.start_line} to {roi.end_line}, samples {roi.start_sample} to {roi.end_sample}"
        rows.append((f"{name}: region of interest", where, ""))
    if said.unused:
        shown = ", ".join(printable(each[:40]) for each in said.unused[:_MOST_SHOWN])
        more = f" and {len(said.unused) - _MOST_SHOWN} more" if len(said.unused) > _MOST_SHOWN else ""
        rows.append((f"{name}: fields not read", shown + more, ""))
    return rows


def _chosen_rows(recording: Recording, settings: ImportSettings) -> list[Row]:
    """What the sweep is made from, and where its numbers are from."""
    try:
        chosen = choose(recording)
        padded = is_padded(chosen)
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
    speed = settings.speed_of_sound_m_s or said.speed_of_sound_m_s or SPEED_OF_SOUND_M_S
    rows += [
        ("elements per line", f"{place.elements_per_line:.6g}", ""),
        *_told("vector pitch from", lambda: _pitch_rows(said, place, settings)),
        ("first line at element", f"{place.first_element:g}, taken as the image's left", ""),
        ("lines taken as", "parallel, of a linear array: its yml does not say", ""),
        ("first sample's depth from", *_depth_source(place, said, speed, settings)),
        ("speed of sound from", _source(settings.speed_of_sound_m_s, said.speed_of_sound_m_s, "assumed"), ""),
    ]
    if said.kind != "envelope":
        rows += _told("band from", lambda: _band_rows(chosen, place, settings))
    if said.kind == "IQ":
        rows.append(("demodulation frequency from", _shift_source(said, settings), ""))
    return [*rows, *_told("gain by frame", lambda: [("gain by frame", _gain_said(recording, chosen), "")])]


def _band_rows(chosen: Chosen, place: Place, settings: ImportSettings) -> list[Row]:
    """The band and the centre of the echoes, whatever else is still to be given."""
    values = signal_values(chosen, place, settings)
    band = values["bandwidth_hz"]
    centre = _source(settings.centre_frequency_hz, chosen.said.transmit_frequency_hz, "not said")
    from_yml = centre.replace("its yml", "transmit frequency in its yml")
    lacking = [name.replace("_hz", "").replace("_", " ") for name, value in values.items() if value is None]
    if band is not None:
        how = "as given" if settings.bandwidth_hz else "measured at -6 dB in this recording's spectrum"
        told = f"{band[0] / 1e6:.2f} to {band[1] / 1e6:.2f} MHz, {how}"
    elif needed := [each for each in lacking if each.endswith(" frequency")]:
        told = f"not said, and not measured without the {' and '.join(needed)}"
    else:
        told = "not said, and not clear in the spectrum"
    centres = centres_of(chosen, place, settings)
    near_far = "not clear" if centres is None else " and ".join(f"{each / 1e6:.2f}" for each in centres)
    return [
        ("band from", told, ""),
        ("echoes' centre, near and far", near_far, "" if centres is None else "MHz"),
        ("centre frequency from", from_yml, ""),
    ]


def _pitch_rows(said: Description, place: Place, settings: ImportSettings) -> list[Row]:
    """Where the distance between lines is from, and how large it makes elements, array and image."""
    pitch = pitch_of(said, place, settings)
    if pitch is None:
        return [("vector pitch from", "not said", "")]
    first, last = said.geometry.receive_element[[0, -1]]
    width_mm = (place.last_element - place.first_element) * pitch.element_mm
    return [
        ("vector pitch from", pitch.source, ""),
        ("element pitch, by it", f"{pitch.element_mm:.4g}", "mm"),
        ("width of the image, by it", f"{width_mm:.2f}", "mm"),
        (
            f"array from element {first:g} to {last:g}, by it",
            f"{(last - first) * pitch.element_mm:.2f}",
            "mm",
        ),
    ]


def _pitch_notes(said: Description, place: Place, settings: ImportSettings) -> list[str]:
    """Say what a distance between lines means where it is none between elements, and what options replace."""
    pitch = pitch_of(said, place, settings)
    notes = []
    if pitch is not None and settings.vector_pitch_mm and round(place.elements_per_line, 3) != 1:
        notes.append(
            f"lines are {place.elements_per_line:.4g} elements apart: {pitch.vector_mm:g} mm between lines "
            f"is an element pitch of {pitch.element_mm:.4g} mm; if {pitch.vector_mm:g} mm is that of the "
            "data sheet, give --element-pitch-mm"
        )
    own_mm = said.element_pitch_mm
    if pitch is not None and own_mm is not None and abs(pitch.element_mm - own_mm) > 1e-6 * own_mm:
        notes.append(f"element pitch {pitch.element_mm:.4g} mm as given, {own_mm:.4g} mm in its yml")
    if settings.probe and said.probe and probe_name(said, None) != probe_name(said, settings.probe):
        notes.append(f"probe {settings.probe} as given, {printable(said.probe)} in its yml")
    return notes


def _covered_rows(recording: Recording) -> list[Row]:
    """Frames of the sweep that the sensor says nothing of."""
    sensor = orientation_of(recording)
    if sensor is None:
        return []
    frame_s, time_s = choose(recording).times_ns / 1e9, sensor.readings.time_s
    before, after = int(np.sum(frame_s < time_s[0])), int(np.sum(frame_s > time_s[-1]))
    in_pauses = int(np.sum(~sensor.covers(frame_s))) - before - after
    told = f"{before} before the sensor's first sample, {after} after its last, {in_pauses} in pauses"
    return [("frames without orientation", told, "")]


def _is_odd(near_hz: float, far_hz: float, transmit_hz: float) -> bool:
    """Whether echoes of tissue cannot have these centres."""
    return far_hz > _MOST_RISE * near_hz or near_hz > _MOST_ABOVE * transmit_hz


def _depth_source(place: Place, said: Description, speed: float, settings: ImportSettings) -> tuple[str, str]:
    if settings.first_sample_depth_mm is not None:
        return "as given", ""
    depth = place.first_depth_mm(settings.sampling_rate_hz or said.sampling_rate_hz, speed)
    if depth is None:
        none = said.delay_samples is None
        return "not said" if none else "not said: its yml's delay is less than 1 us", ""
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
        return "not said"
    if receive.shallow_hz == receive.deep_hz:
        return "its yml"
    ends = (
        f"{receive.shallow_hz / 1e6:g} to {receive.deep_hz / 1e6:g} MHz over {receive.filter_depth_mm:g} mm"
    )
    return f"its yml: {ends}, turned to that of the line's middle"


def _gain_said(recording: Recording, chosen: Chosen) -> str:
    curves = curves_of(recording, chosen)
    if curves is None:
        return "not told: taken as the same"
    if len(set(curves)) == 1:
        return "the same in all frames: left as it is"
    grey = chosen.said.kind == "envelope"
    undone = "left in the grey levels" if grey else "undone relative to the first frame"
    return f"differs between frames: {undone}"
