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
    if (steered := np.flatnonzero(said.angle_deg)).size:
        i = int(steered[0])
        raise InvalidInputError(
            f"{said.where}: lines[{i}]: angle: expected 0 (lines that are not steered), got "
            f"{said.angle_deg[i]:g} deg, and {steered.size} of {said.lines} lines steered: record without "
            "steering and Doppler"
        )
    lines, samples = slice(0, said.lines), slice(0, said.samples)
    if cropped and said.roi is not None:
        roi = said.roi
        lines, samples = slice(roi.start_line, roi.end_line + 1), slice(roi.start_sample, roi.end_sample + 1)
    elements = said.receive_element[lines]
    step = _step(f"{said.where}: lines", elements, lines.start)
    first_sample = None if said.delay_samples is None else said.delay_samples + samples.start
    return Place(lines, samples, float(elements[0]), float(elements[-1]), step, first_sample)


def probe_name(said: Description, probe: str | None) -> str:
    """Name a probe in one spelling, so that curves and calibrations of it are found to be of it."""
    named = probe or said.probe
    model = _model(named)
    return f"Clarius {model}" if model in ELEMENT_PITCH_MM else named


def pitch_of(said: Description, place: Place, settings: ImportSettings) -> tuple[float, str] | None:
    """Find the distance between lines, mm, and where it is from; None where nothing tells.

    Raises
    ------
    InvalidInputError
        If two sources contradict each other, the model's lines are not parallel, or it is not known.
    """
    per_line = place.elements_per_line
    given = {
        "--element-pitch-mm": settings.element_pitch_mm,
        f"--vector-pitch-mm / {per_line:g} elements a line": (
            None if settings.vector_pitch_mm is None else settings.vector_pitch_mm / per_line
        ),
        f"--probe {settings.probe}": None if settings.probe is None else _model_pitch_mm(said, settings),
    }
    _require_alike(said, given)
    if settings.probe is not None and settings.element_pitch_mm is None and settings.vector_pitch_mm is None:
        _require_alike(said, {**given, "probe: pitch of the yml": said.element_pitch_mm})
    if settings.vector_pitch_mm is not None:
        return settings.vector_pitch_mm, "as given"
    model_mm = _model_pitch_mm(said, settings)
    sources = {
        "as given": settings.element_pitch_mm,
        "its yml": said.element_pitch_mm,
        f"the maker's table, {_model(settings.probe or said.probe)}": model_mm,
    }
    for source, element_mm in sources.items():
        if element_mm is not None:
            return element_mm * per_line, f"{per_line:g} elements a line (yml) x {element_mm:g} mm ({source})"
    return None


def _model(named: str) -> str:
    return re.sub(r"[^A-Z0-9]", "", named.upper()).removeprefix("CLARIUS")


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
    raise InvalidInputError(
        f"{said.where}: --probe: expected a model whose element pitch is published "
        f"({', '.join(ELEMENT_PITCH_MM)}), got {named[:40]!r}: give --element-pitch-mm"
    )


def _require_alike(said: Description, pitches: dict[str, float | None]) -> None:
    """Refuse element pitches that are not of one array."""
    known = [(name, pitch) for name, pitch in pitches.items() if pitch is not None]
    for name, pitch in known[1:]:
        if abs(pitch - known[0][1]) > _ALIKE * pitch:
            raise InvalidInputError(
                f"{said.where}: expected one distance between elements, got {known[0][1]:.4g} mm "
                f"({known[0][0]}) and {pitch:.4g} mm ({name})"
            )


def _step(where: str, elements: FloatArray, first: int) -> float:
    """Distance between lines, in elements."""
    if elements.size < 2:
        raise InvalidInputError(f"{where}: expected two lines or more, got {elements.size}")
    steps = np.diff(elements)
    step = float((elements[-1] - elements[0]) / (elements.size - 1))
    if not (steps > 0).all():
        i = int(np.argmax(steps <= 0))
        got = "again" if steps[i] == 0 else f"after {elements[i]:g}"
        raise InvalidInputError(
            f"{where}[{first + i + 1}]: rx element: expected lines from the lowest element up, one a place, "
            "got "
            f"{elements[i + 1]:g} {got}: packets of a Doppler mode are no image"
        )
    off = np.abs(elements - elements[0] - step * np.arange(elements.size))
    if off.max() > _EVEN * step:
        i = int(np.argmax(off))
        raise InvalidInputError(
            f"{where}[{first + i}]: rx element: expected evenly spaced lines, got {elements[i]:g} where "
            f"{elements[0] + step * i:g} is even"
        )
    return step


def _polar(where: str, what: str) -> str:
    return (
        f"{where}: expected parallel lines, got {what}: its lines fan out, and a sweep has one distance "
        "between them. Needed would be the radius of the array, the angle between its lines, and resampling"
    )
