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

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import skew
from speckle3d.core.images import spread_frames

PARAMETERS = ("tilt", "yaw", "roll", "x", "y", "z")
"""Small turns about the image's x, y and z, and shifts along them."""

LEAST = 0.15
"""Disagreement in mm of a mm of error below which sweeps are refused: what a tracker displaces one sweep
against the other by, 0.15 mm, would be an error of a millimetre. Along the beam, fans of 21 degrees; across,
sweeps that cross by 9."""

WEAK = 0.2
"""As `LEAST`: below, the verdict says "weak"; along the beam, fans of 28 degrees; across, 11 degrees."""

_FRAMES = 12
"""Images whose beams are compared."""


@dataclass(frozen=True)
class Angulation:
    """Sensitivity of two sweeps' disagreement to errors of a calibration.

    Attributes
    ----------
    crossing_deg : float
        Between the mean directions in which the two probes' image lines run across, 0 to 90.
    fan_deg : tuple of float
        By how much the beam's direction turns within each sweep.
    """

    crossing_deg: float
    fan_deg: tuple[float, float]

    @property
    def sensitivity(self) -> dict[str, float]:
        """Disagreement of the sweeps, mm per mm of error, of errors across the image and along the beam."""
        across = 2.0 * np.sin(np.deg2rad(self.crossing_deg) / 2.0)
        # Of beams spread evenly over an angle the root mean square deviation is the angle over root twelve.
        along = np.linalg.norm(np.deg2rad(self.fan_deg)) / np.sqrt(12.0)
        return {"x": float(across), "y": float(along)}

    @property
    def advice(self) -> str:
        """What is missing from the motion, in words."""
        motions = {
            "x": "cross the sweeps: turn the probe by about 90 degrees between them",
            "y": "fan in each: tilt the probe to and fro by 40 degrees within each sweep",
        }
        return "; ".join(motions[name] for name, share in self.sensitivity.items() if share < WEAK)

    @property
    def verdict(self) -> str:
        """One line: sufficient, or weak with the weakest parameter and what to do."""
        name, share = min(self.sensitivity.items(), key=lambda item: item[1])
        if share >= WEAK:
            return "sufficient"
        return f"weak: 1 mm of error in {name} shows by {share:.2f} mm; {self.advice}"

    def require(self, part: float = 1.0) -> None:
        """Refuse sweeps that cannot determine every parameter.

        Parameters
        ----------
        part : float
            Of the limit that must be reached: less than 1 where only a rough mounting is known.

        Raises
        ------
        InsufficientDataError
            Naming the parameter that cannot be found.
        """
        if min(self.sensitivity.values()) < part * LEAST:
            raise InsufficientDataError(
                f"expected two sweeps that cross and fan, got {self.crossing_deg:.0f} degrees between them "
                f"and fans of {self.fan_deg[0]:.0f} and {self.fan_deg[1]:.0f} degrees; {self.advice}"
            )


def angulation(
    first: RigidTransform, second: RigidTransform, sensor_from_image: RigidTransform
) -> Angulation:
    """Judge two sweeps by their poses alone.

    Parameters
    ----------
    first, second : RigidTransform, length n and m
        World from sensor of the frames of each sweep.
    sensor_from_image : RigidTransform
        The estimate to start from.

    Raises
    ------
    InsufficientDataError
        If a sweep has fewer than two frames.
    """
    if min(len(first), len(second)) < 2:
        raise InsufficientDataError(
            f"expected readings of the tracker in both sweeps, got some for {len(first)} and {len(second)} "
            "frames: do the clocks belong together?"
        )
    turns = [(sweep * sensor_from_image).rotation for sweep in (first, second)]
    across, beams = ([turn.apply(axis) for turn in turns] for axis in np.eye(3)[:2])
    # As seen along the beams: how a probe leans aside does not count.
    down = sum(beam.mean(axis=0) for beam in beams)
    flat = [
        line.mean(axis=0) - down * (line.mean(axis=0) @ down) / max(float(down @ down), 1e-12)
        for line in across
    ]
    cosine = abs(float(flat[0] @ flat[1])) / float(np.prod([np.linalg.norm(line) for line in flat]))
    few = [beam[spread_frames(len(beam), _FRAMES)] for beam in beams]
    fans = [float(np.rad2deg(np.arccos(np.clip((beam @ beam.T).min(), -1.0, 1.0)))) for beam in few]
    return Angulation(float(np.rad2deg(np.arccos(min(cosine, 1.0)))), (fans[0], fans[1]))


def point_motion(local_mm: FloatArray) -> FloatArray:
    """How points of the image move with its turns and shifts, in its frame, shape (p, 3) to (p, 3, 6)."""
    return np.concatenate([-skew(local_mm), np.broadcast_to(np.eye(3), (len(local_mm), 3, 3))], axis=2)
