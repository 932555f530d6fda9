"""Where the samples of a frame lie: pitch of the lines, first line and first sample, what is left out.

Trusted for the line pitch is the yml's ``rx element``, the place of a line in elements of the array, times
the distance between elements. That is given by ``element_pitch_mm``, by the yml's probe where it says, or by
the probe's model, in this order; ``vector_pitch_mm`` replaces the product. Pitches that differ by more than
5 % are told. Lines that are steered, unevenly spaced, or repeated (several packets a line, as in Doppler
modes) are refused. The first line is taken as the left of the image.

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

import numpy as np

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


def place_of(said: Description, kept: slice) -> tuple[float, float]:
    """Place of the first kept line in the array, and the distance between lines, in elements.

    Raises
    ------
    InvalidInputError
        Naming the line that is steered, unevenly spaced or repeated, or a curved array.
    """
    where = said.fields.where
    if radius_mm := said.of_probe("radius"):
        raise InvalidInputError(_polar(where, f"a curved array of {radius_mm:g} mm radius"))
    if (steered := np.flatnonzero(said.angle_deg)).size:
        i = int(steered[0])
        raise InvalidInputError(
            f"{where}: lines[{i}]: angle: expected 0 (lines that are not steered), got "
            f"{said.angle_deg[i]:g} deg, and {steered.size} of {said.lines} lines steered: record without "
            "steering and Doppler"
        )
    elements = said.receive_element[kept]
    if elements.size < 2:
        raise InvalidInputError(f"{where}: lines: expected two lines or more, got {elements.size}")
    step = float((elements[-1] - elements[0]) / (elements.size - 1))
    off = np.abs(elements - elements[0] - step * np.arange(elements.size))
    if not (np.diff(elements) > 0).all() or off.max() > _EVEN * step:
        i = int(np.argmax(off > _EVEN * abs(step)))
        raise InvalidInputError(
            f"{where}: lines[{kept.start + i}]: rx element: expected lines evenly spaced from the lowest "
            f"element up, one a place, got {elements[i]:g} where {elements[0] + step * i:g} is even: packets "
            "of a Doppler mode are no image"
        )
    return float(elements[0]), step


def first_depth_mm(said: Description, first: int, rate_hz: float, spacing_mm: float) -> float | None:
    """Depth of the first kept sample; None where it is not said, or would be above depth 0.

    Less than a sample above is 0: the delay is a whole number of samples.
    """
    delay = said.fields.optional("delay samples")
    after = -1.0 if delay is None else delay + first - BEFORE_DEPTH_S * rate_hz
    return max(after, 0.0) * spacing_mm if after > -1.0 else None


def probe_name(said: Description, probe: str | None) -> str:
    """Name a probe in one spelling, so that curves and calibrations of it are found to be of it."""
    named = probe or said.probe
    return f"Clarius {_model(named)}" if _model(named) in ELEMENT_PITCH_MM else named


def element_pitches(said: Description, settings: ImportSettings, per_line: float) -> dict[str, float]:
    """Distances between elements, mm, by where they are from, the most trusted first.

    Raises
    ------
    InvalidInputError
        If the model's lines are not parallel.
    """
    named = settings.probe or said.probe
    if _model(named).startswith(CONVEX):
        raise InvalidInputError(_polar(said.fields.where, f"the probe {named}"))
    line_mm = settings.vector_pitch_mm
    pitches = {
        "--vector-pitch-mm": None if line_mm is None else line_mm / per_line,
        "as given": settings.element_pitch_mm,
        "its yml": said.of_probe("pitch"),
        f"the maker's table, {_model(named)}": ELEMENT_PITCH_MM.get(_model(named)),
    }
    return {source: pitch for source, pitch in pitches.items() if pitch is not None}


def differing(pitches: dict[str, float]) -> list[str]:
    """Tell distances between elements that are not of one array."""
    first = next(iter(pitches.values()), 0.0)
    if all(abs(pitch - first) <= _ALIKE * pitch for pitch in pitches.values()):
        return []
    listed = ", ".join(f"{pitch:.4g} mm ({source})" for source, pitch in pitches.items())
    return [f"distances between elements: {listed}: the first is used"]


def _model(named: str) -> str:
    return re.sub(r"[^A-Z0-9]", "", named.upper()).removeprefix("CLARIUS")


def _polar(where: str, what: str) -> str:
    return (
        f"{where}: expected parallel lines, got {what}: its lines fan out, and a sweep has one distance "
        "between them. Needed would be the radius of the array, the angle between its lines, and resampling"
    )
