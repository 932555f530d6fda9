"""Whether two sweeps are angulated enough to determine a calibration, judged by their poses before solving.

A wrong calibration moves the same point of the object differently in two images. An error that moves it alike
in both, as a shift along the beam does if the probe is never tilted, cannot be seen by comparing images.

References
----------
.. [1] W. Wein and A. Khamene, "Image-based method for in-vivo freehand ultrasound calibration", SPIE Medical
   Imaging 6920, 2008, section 2.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import skew

PARAMETERS = ("tilt", "yaw", "roll", "x", "y", "z")
"""Small turns about the image's x, y and z through its centre, and shifts along them."""

REFUSED = 0.15
"""Disagreement in mm of a mm (or of an image's half size times a radian) of calibration error below which
sweeps are refused: what a tracker displaces one sweep against the other by, 0.15 mm, would be an error of a
millimetre. Along the beam, fans of 21 degrees; across, sweeps that cross by 9."""

WEAK = 0.2
"""As `REFUSED`: below, the verdict says "weak"; along the beam, fans of 28 degrees."""

LEAST_CROSSING_DEG = 10.0
"""Angle between two sweeps below which they are called parallel and refused. By crossing alone an error
across the image shows by 2 sin(angle / 2), here 0.17 mm of a mm; what shows more comes of the hand's leaning,
of which other errors take their part: of 28 simulated pairs of parallel sweeps that fan by 30 and 50 degrees
one passed `REFUSED` by that."""

_AMPLE = 0.3
"""Disagreement of a mm that crossing, or fans, should bring by themselves for advice not to ask for more."""

_FRAMES, _POINTS = 12, 9
_LEAST_OVERLAP = 0.25
"""Overlap below which the sweeps are judged with their middles put in one place: a start that is off by 20 mm
puts sweeps of one place apart."""


@dataclass(frozen=True)
class Angulation:
    """How strongly each error of a calibration shows where two sweeps see the same points.

    Attributes
    ----------
    crossing_deg : float
        Between the mean directions in which the two probes' image lines run across, 0 to 90.
    fan_deg : tuple of float
        By how much the beam's direction turns within each sweep.
    overlap : tuple of float
        Share of each sweep's image area that the other sweep covers too.
    alone : ndarray, shape (6,)
        RMS disagreement in mm of an error of 1 mm or 1 degree of one parameter, in the order of `PARAMETERS`.
    recoverable : ndarray, shape (6,)
        The same with all other parameters free to hide it.
    """

    crossing_deg: float
    fan_deg: tuple[float, float]
    overlap: tuple[float, float]
    alone: FloatArray
    recoverable: FloatArray
    half_size_mm: float

    @property
    def strength(self) -> FloatArray:
        """`recoverable` in mm per mm, an angle counting as what it moves at the image's half size."""
        per_mm = self.recoverable.copy()
        per_mm[:3] /= np.deg2rad(1.0) * self.half_size_mm
        return per_mm

    @property
    def weakest(self) -> str:
        """Name of the parameter with the least `strength`."""
        return PARAMETERS[int(np.argmin(self.strength))]

    @property
    def advice(self) -> str:
        """What is missing from the motion, in words."""
        crossing = 2.0 * np.sin(np.deg2rad(self.crossing_deg) / 2.0)
        fans = float(np.linalg.norm(np.deg2rad(self.fan_deg))) / np.sqrt(12.0)
        told = []
        if crossing < _AMPLE or fans >= _AMPLE:
            told.append("cross the sweeps: turn the probe by about 90 degrees between them")
        if fans < _AMPLE:
            told.append("fan in each: tilt the probe to and fro by 40 degrees within each sweep")
        return "; ".join(told)

    @property
    def verdict(self) -> str:
        """One line: sufficient, weak or insufficient, with the weakest parameter and what to do."""
        weakest = float(self.strength.min())
        if weakest >= WEAK and not self.parallel:
            return "sufficient"
        kind = "insufficient" if weakest < REFUSED or self.parallel else "weak"
        return f"{kind}: an error in {self.weakest} shows by {weakest:.2f} mm per mm; {self.advice}"

    @property
    def parallel(self) -> bool:
        """Whether the sweeps hardly cross."""
        return self.crossing_deg < LEAST_CROSSING_DEG

    def require(self, part: float = 1.0) -> None:
        """Refuse sweeps that cannot determine every parameter.

        Parameters
        ----------
        part : float
            Of the limits that must be reached: less than 1 where only a rough mounting is known.

        Raises
        ------
        InsufficientDataError
            Naming the parameter that cannot be found.
        """
        found = float(self.strength.min())
        if found < part * REFUSED or self.crossing_deg < part * LEAST_CROSSING_DEG:
            raise InsufficientDataError(
                f"expected two angulated sweeps that cross, got {self.crossing_deg:.0f} degrees between them "
                f"and fans of {self.fan_deg[0]:.0f} and {self.fan_deg[1]:.0f} degrees: an error of 1 mm in "
                f"{self.weakest} would show by {found:.2f} mm; {self.advice}"
            )


def angulation(
    first: RigidTransform, second: RigidTransform, sensor_from_image: RigidTransform, corners_mm: FloatArray
) -> Angulation:
    """Judge two sweeps by their poses alone.

    Parameters
    ----------
    first, second : RigidTransform, length n and m
        World from sensor of the frames of each sweep.
    sensor_from_image : RigidTransform
        The estimate to start from; only how much the sweeps overlap depends on it strongly.
    corners_mm : ndarray, shape (4, 3)
        Of the image, in its own frame.

    Raises
    ------
    InsufficientDataError
        If a sweep has fewer than two frames, or the sweeps never cross, however far their images reach.
    """
    if min(len(first), len(second)) < 2:
        raise InsufficientDataError(
            f"expected readings of the tracker in both sweeps, got some for {len(first)} and {len(second)} "
            "frames: do the clocks belong together?"
        )
    one, other = first * sensor_from_image, second * sensor_from_image
    centre, half = corners_mm.mean(axis=0), 0.5 * np.ptp(corners_mm, axis=0)
    blocks, overlap = _both_ways(one, other, corners_mm)
    if max(overlap) < _LEAST_OVERLAP:
        # A bad start puts sweeps of one place apart, but hardly changes the angles between them.
        apart = one.apply(centre).mean(axis=0) - other.apply(centre).mean(axis=0)
        blocks, _ = _both_ways(one, RigidTransform.from_translation(apart) * other, corners_mm)
    if not len(blocks):
        raise InsufficientDataError(
            "expected two sweeps of one place, got images that nowhere reach the planes of the other sweep's"
        )
    information = np.einsum("pij,pik->jk", blocks, blocks) / len(blocks)
    scale = np.array([np.deg2rad(1.0)] * 3 + [1.0] * 3)
    information *= np.outer(scale, scale)
    alone = np.sqrt(np.diag(information))
    return Angulation(
        _crossing_deg(one, other),
        (_fan_deg(one), _fan_deg(other)),
        overlap,
        alone,
        # Roots of the Schur complements: what is left of each with the others free to make up for it.
        np.diag(np.linalg.inv(information + (1e-10 * np.trace(information) + 1e-30) * np.eye(6))) ** -0.5,
        float(np.linalg.norm(half[:2]) / np.sqrt(2.0)),
    )


def point_motion(local_mm: FloatArray) -> FloatArray:
    """How points of the image move with its turns and shifts, in its frame, shape (p, 3) to (p, 3, 6)."""
    return np.concatenate([-skew(local_mm), np.broadcast_to(np.eye(3), (len(local_mm), 3, 3))], axis=2)


def _both_ways(
    one: RigidTransform, other: RigidTransform, corners_mm: FloatArray
) -> tuple[FloatArray, tuple[float, float]]:
    """Sensitivities at points of either sweep that the other sees too, and the shares of those points."""
    first, seen = _disagreements(one, other, corners_mm)
    second, seen_back = _disagreements(other, one, corners_mm)
    shares = float(seen.mean()), float(seen_back.mean())
    return np.concatenate([first[seen], second[seen_back]]), shares


def _disagreements(
    one: RigidTransform, other: RigidTransform, corners_mm: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """d(disagreement)/d(parameters) at points of some images of one sweep, and which points both see.

    Shapes (p, 3, 6) and (p,); NaN where the other sweep's planes never pass the point.
    """
    low, size = corners_mm.min(axis=0), np.ptp(corners_mm, axis=0)
    centre = low + size / 2.0
    # Centres of cells, so that each point stands for the same area.
    share = (np.arange(_POINTS) + 0.5) / _POINTS
    across, down = np.meshgrid(share, share)
    points = low + size * np.column_stack([across.ravel(), down.ravel(), np.zeros(across.size)])
    blocks, inside = [], []
    for pose in _some(one):
        seen = other.inv().as_matrix() @ pose.as_matrix() @ np.column_stack([points, np.ones(len(points))]).T
        away = seen[:, 2]
        nearest = np.abs(away).argmin(axis=0)
        local = seen[nearest, :3, np.arange(len(points))]
        turns = other.as_matrix()[nearest][:, :3, :3]
        block = turns @ point_motion(local - centre) - pose.rotation.as_matrix() @ point_motion(
            points - centre
        )
        passes = (away.min(axis=0) <= 0.0) & (away.max(axis=0) >= 0.0)
        block[~passes] = np.nan
        blocks.append(block)
        inside.append(passes & (np.abs(local - centre)[:, :2] <= size[:2] / 2.0 + 1e-9).all(axis=1))
    return np.concatenate(blocks), np.concatenate(inside)


def _some(sweep: RigidTransform) -> RigidTransform:
    """Poses of a few images spread over a sweep."""
    return sweep[np.unique(np.linspace(0, len(sweep) - 1, _FRAMES).round().astype(int))]


def _crossing_deg(one: RigidTransform, other: RigidTransform) -> float:
    """Angle between the mean lateral axes as seen along the beams: how a probe leans aside does not count."""
    beam = sum(each.rotation.apply([0.0, 1.0, 0.0]).mean(axis=0) for each in (one, other))
    beam = beam / max(float(np.linalg.norm(beam)), 1e-12)
    across = [each.rotation.apply([1.0, 0.0, 0.0]).mean(axis=0) for each in (one, other)]
    across = [each - (each @ beam) * beam for each in across]
    cosine = abs(float(across[0] @ across[1])) / float(np.prod([np.linalg.norm(each) for each in across]))
    return float(np.rad2deg(np.arccos(min(cosine, 1.0))))


def _fan_deg(sweep: RigidTransform) -> float:
    """The largest angle between the beams of a few of a sweep's images."""
    beams = _some(sweep).rotation.apply([0.0, 1.0, 0.0])
    return float(np.rad2deg(np.arccos(np.clip((beams @ beams.T).min(), -1.0, 1.0))))
