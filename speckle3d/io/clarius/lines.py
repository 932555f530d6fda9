"""Where the samples of a frame lie: pitch of the lines, first line and first sample, what is left out.

Trusted for the line pitch is the yml's ``rx element``, the place of a line in elements of the array, times
the distance between elements. That is given by ``element_pitch_mm``, by the yml's probe where it says, or by
the probe's model; ``vector_pitch_mm`` replaces the product. Pitches that differ by more than 5 % are refused,
unless one is an option that replaces the yml's. Lines that are steered, unevenly spaced, or repeated (several
packets a line, as in Doppler modes) are refused. The first line is taken as the left of the image.

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
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.clarius.sidecars import Description
from speckle3d.io.import_settings import ImportSettings

ELEMENT_PITCH_MM = {"L20HD3": 0.13, "L15HD3": 0.26, "L7HD3": 0.2, "PALHD3": 0.26}
"""Of the linear arrays in the maker's table of HD3 probes [2]_; of the PAL, its linear side."""

CONVEX = ("C3", "C7", "EC7", "PH", "PA2", "PA", "TV")
"""Models whose lines are not parallel."""

BEFORE_DEPTH_S = 1e-6
"""Delay that is not depth; see above."""

_ALIKE = 0.05
"""Published pitches are rounded to 0.01 mm, as 0.13."""

_EVEN = 1e-3
"""How far a line may be from its place, in pitches; places are written to 17 digits."""


@dataclass(frozen=True)
class Place:
    """Where the kept part of a frame lies.

    Attributes
    ----------
    lines, samples : slice
        Kept, of those in the file.
    first_element, last_element : float
        Places of the first and the last kept line in the array.
    elements_per_line : float
        Distance between lines, in elements.
    first_sample : float, optional
        Samples between transmission and the first kept one; None where the yml does not say.
    """

    lines: slice
    samples: slice
    first_element: float
    last_element: float
    elements_per_line: float
    first_sample: float | None

    def first_depth_mm(self, sampling_rate_hz: float, speed_of_sound_m_s: float) -> float | None:
        """Depth of the first kept sample; None where it is not said, or would be above depth 0.

        Less than a sample above is 0: the delay is a whole number of samples.
        """
        if self.first_sample is None:
            return None
        after_s = self.first_sample / sampling_rate_hz - BEFORE_DEPTH_S
        if after_s * sampling_rate_hz <= -1:
            return None
        return max(after_s, 0.0) * speed_of_sound_m_s * 1e3 / 2


def place_of(said: Description, cropped: bool) -> Place:
    """Find where the lines and samples lie, in elements and samples.

    Parameters
    ----------
    cropped : bool
        Whether what is outside the region of interest is left out.

    Raises
    ------
    InvalidInputError
        Naming the line that is steered, unevenly spaced or repeated, or a curved array.
    """
    if said.radius_mm:
        raise InvalidInputError(_polar(said.where, f"a curved array of {said.radius_mm:g} mm radius"))
    _require_straight(said)
    lines, samples = slice(0, said.lines), slice(0, said.samples)
    if cropped and said.roi is not None:
        roi = said.roi
        lines, samples = slice(roi.start_line, roi.end_line + 1), slice(roi.start_sample, roi.end_sample + 1)
    elements = said.geometry.receive_element[lines]
    step = _step(said, elements, lines.start)
    first_sample = None if said.delay_samples is None else said.delay_samples + samples.start
    return Place(lines, samples, float(elements[0]), float(elements[-1]), step, first_sample)


def require_roi(said: Description) -> None:
    """Refuse a region of interest that is not inside the frame.

    Raises
    ------
    InvalidInputError
        Naming the field.
    """
    roi = said.roi
    if roi is None:
        return
    for what, first, last, count in (
        ("line", roi.start_line, roi.end_line, said.lines),
        ("sample", roi.start_sample, roi.end_sample, said.samples),
    ):
        if not first < last < count:
            raise InvalidInputError(
                f"{said.where}: roi: expected {what}s from 0 to {count - 1}, got {first} to {last}"
            )


def probe_name(said: Description, probe: str | None) -> str:
    """Name a probe in one spelling, so that curves and calibrations of it are found to be of it."""
    named = probe or said.probe
    model = _model(named)
    return f"Clarius {model}" if model in ELEMENT_PITCH_MM else named


def _model(named: str) -> str:
    return re.sub(r"[^A-Z0-9]", "", named.upper()).removeprefix("CLARIUS")


@dataclass(frozen=True)
class Pitch:
    """Distance between lines, between elements, and where they are from."""

    vector_mm: float
    element_mm: float
    source: str


def pitch_of(said: Description, place: Place, settings: ImportSettings) -> Pitch | None:
    """Find the distance between lines; None where nothing tells.

    Raises
    ------
    InvalidInputError
        If two sources contradict each other, the model's lines are not parallel, or it is not known.
    """
    model_mm = _model_pitch_mm(said, settings)
    per_line = place.elements_per_line
    given_mm, line_mm = settings.element_pitch_mm, settings.vector_pitch_mm
    if given_mm is not None and line_mm is not None:
        _require_alike(said, "--vector-pitch-mm", line_mm / per_line, "--element-pitch-mm", given_mm)
    option = None if line_mm is None else line_mm / per_line
    option = given_mm if option is None else option
    named = "--element-pitch-mm" if line_mm is None else f"--vector-pitch-mm / {per_line:g} elements a line"
    if settings.probe is not None and model_mm is not None:
        if option is not None:
            _require_alike(said, named, option, f"--probe {settings.probe}", model_mm)
        if said.element_pitch_mm is not None:
            _require_alike(said, "probe: pitch", said.element_pitch_mm, f"--probe {settings.probe}", model_mm)
    if line_mm is not None:
        return Pitch(line_mm, line_mm / per_line, "as given")
    for element_mm, source in (
        (given_mm, "as given"),
        (said.element_pitch_mm, "its yml"),
        (model_mm, f"the maker's table, {_model(settings.probe or said.probe)}"),
    ):
        if element_mm is not None:
            whole = f"{per_line:g} elements a line (yml) x {element_mm:g} mm ({source})"
            return Pitch(element_mm * per_line, element_mm, whole)
    return None


def _model_pitch_mm(said: Description, settings: ImportSettings) -> float | None:
    """Published pitch of the probe's model; None without a model, or where another source serves."""
    named = settings.probe or said.probe
    model = _model(named)
    if not model or model in ELEMENT_PITCH_MM:
        return ELEMENT_PITCH_MM.get(model)
    if model.startswith(CONVEX):
        raise InvalidInputError(_polar(said.where, f"the probe {named}"))
    if settings.element_pitch_mm or settings.vector_pitch_mm or said.element_pitch_mm:
        return None
    known = ", ".join(ELEMENT_PITCH_MM)
    raise InvalidInputError(
        f"{said.where}: --probe: expected a model whose element pitch is published ({known}), got "
        f"{named[:40]!r}: give --element-pitch-mm"
    )


def _require_alike(said: Description, one: str, one_mm: float, other: str, other_mm: float) -> None:
    """Refuse two element pitches that are not of one array."""
    if abs(one_mm - other_mm) > _ALIKE * other_mm:
        raise InvalidInputError(
            f"{said.where}: expected one distance between elements, got {one_mm:.4g} mm ({one}) and "
            f"{other_mm:.4g} mm ({other})"
        )


def _require_straight(said: Description) -> None:
    angles = said.geometry.angle_deg
    if (steered := np.flatnonzero(angles)).size:
        i = int(steered[0])
        raise InvalidInputError(
            f"{said.where}: lines[{i}]: angle: expected 0 (lines that are not steered), got {angles[i]:g} "
            f"deg, and {steered.size} of {angles.size} lines steered: record without steering and Doppler"
        )


def _step(said: Description, elements: FloatArray, first: int) -> float:
    """Distance between lines, in elements."""
    where = f"{said.where}: lines"
    if elements.size < 2:
        raise InvalidInputError(f"{where}: expected two lines or more, got {elements.size}")
    steps = np.diff(elements)
    if (again := np.flatnonzero(steps == 0)).size:
        raise InvalidInputError(
            f"{where}[{first + int(again[0]) + 1}]: rx element: expected one line a place, got several at "
            f"{elements[again[0]]:g}: packets of a Doppler mode are no image"
        )
    step = float((elements[-1] - elements[0]) / (elements.size - 1))
    if step <= 0:
        i = 1 + int(np.argmax(steps < 0))
        raise InvalidInputError(
            f"{where}[{first + i}]: rx element: expected lines from the lowest element up, got "
            f"{elements[i]:g} after {elements[i - 1]:g}"
        )
    off = np.abs(elements - elements[0] - step * np.arange(elements.size))
    if off.max() > _EVEN * step:
        i = int(np.argmax(off))
        raise InvalidInputError(
            f"{where}[{first + i}]: rx element: expected evenly spaced lines, got "
            f"{elements[i]:g} where {elements[0] + step * i:g} is even"
        )
    return step


def _polar(where: str, what: str) -> str:
    return (
        f"{where}: expected parallel lines, got {what}: its lines fan out, and a sweep has one distance "
        "between them. Needed would be the radius of the array, the angle between its lines, and resampling"
    )
