"""Calibration with a plane.

References
----------
.. [1] Prager et al., "Automatic calibration for 3-D free-hand ultrasound", CUED/F-INFENG/TR 303, 1997:
   sections 3.3, 4.2 and appendix A.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.chain import ANGLES, POSE, PROBE, Chain, ChainSolution, ImagePoints, SeenAs, as_directions
from calibration.identifiability import judge, require_adequate
from calibration.solver import (
    OUTLIER_SIGMA,
    SOME_FRAMES,
    first_guess,
    probe_parameters,
    residuals_of,
    sigma_of,
    solve_chain,
)
from calibration.starts import angle_starts, distance_start, hemisphere, in_plane_mirror
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError

_FEWEST_LINES = 6
"""Two equations each: the fewest for eleven unknowns."""

_PIXEL_MM = 0.15
"""Pixel size of an image some hundred pixels high and some centimetres deep, if none is given."""

_SAME = 0.02
"""Two starts that settle at residuals as close as this share have found the same; no more are tried."""
Stages = Literal["three", "one"]


@dataclass(frozen=True)
class Plane:
    """A plane at z = 0 of its own frame: one equation for each point (TR 303, equation 8)."""

    determined: tuple[str, ...] = ("z_c", "beta_c", "gamma_c")
    seen_as: SeenAs = "line"

    def vanishing(self, points: ImagePoints) -> tuple[FloatArray, FloatArray]:
        """Height above the plane."""
        n = len(points)
        return np.broadcast_to(np.array([[0.0, 0.0, 1.0]]), (n, 1, 3)), np.zeros((n, 1))


@dataclass(frozen=True)
class LineDirections:
    """A plane known by the directions of its lines alone: lines lie in it, wherever it is (appendix A).

    `ImagePoints.pixels` then holds directions and the poses of the sensor are used without their translation.

    Parameters
    ----------
    pixel_mm : ndarray, shape (2,)
        For the length of a direction, which is brought to one.
    level : bool
        The plane's normal is the world's z axis.
    """

    pixel_mm: FloatArray
    level: bool = False
    seen_as: SeenAs = "direction"

    @property
    def determined(self) -> tuple[str, ...]:
        """The two angles of the plane, unless it is level."""
        return () if self.level else ("beta_c", "gamma_c")

    def vanishing(self, points: ImagePoints) -> tuple[FloatArray, FloatArray]:
        """Sine of the angle between line and plane."""
        lengths = np.linalg.norm(points.pixels * self.pixel_mm, axis=1)
        rows = np.zeros((len(points), 1, 3))
        rows[:, 0, 2] = 1.0 / lengths
        return rows, np.zeros((len(points), 1))


def calibrate_plane(
    lines: ImagePoints,
    pixel_mm: FloatArray | None = None,
    fit_pixels: bool = True,
    stages: Stages = "three",
    outlier_sigma: float = OUTLIER_SIGMA,
) -> ChainSolution:
    """Calibrate a 6-DOF sensor from lines of a plane: the floor of a water bath, or the Cambridge phantom.

    Parameters
    ----------
    lines : ImagePoints
        Two points of the plane's line in each frame (`ImagePoints.of_lines`).
    pixel_mm : ndarray, shape (2,), optional
        Column pitch and row spacing from the scanner's calipers; needed unless they are fitted.
    fit_pixels : bool
        Estimate the pixel size too: eleven parameters, else nine.
    stages : str
        ``"three"``: angles from line directions, then distances, then all. ``"one"``: all at once, from
        several mountings.

    Raises
    ------
    InsufficientDataError
        If there are too few lines, they contradict each other, or the motion does not determine the answer;
        then the missing motion is named.
    """
    if len(lines) < 2 * _FEWEST_LINES:
        raise InsufficientDataError(
            f"expected lines in at least {_FEWEST_LINES} frames, got {len(lines) // 2}"
        )
    probe, held = probe_parameters(fit_pixels, pixel_mm)
    start = _three_stages(lines, held) if stages == "three" else _one_stage(lines, held, probe)
    solution = solve_chain(lines, Plane(), start, probe, outlier_sigma)
    if fit_pixels and judge(solution).refused:
        size = np.full(2, _PIXEL_MM) if pixel_mm is None else np.asarray(pixel_mm, dtype=float)
        solution = _from_plausible_pixels(lines, size, outlier_sigma)
    return facing_up(require_adequate(solution))


def _from_plausible_pixels(lines: ImagePoints, pixel_mm: FloatArray, outlier_sigma: float) -> ChainSolution:
    """Solve again with the pixels held at first: free ones may shrink to nothing where the motion is poor.

    If they shrink again, the solution with held pixels is returned as if they were free, for `judge`.
    """
    start = _three_stages(lines, pixel_mm)
    held = solve_chain(lines, Plane(), start, POSE, outlier_sigma)
    again = solve_chain(lines, Plane(), held.chain, PROBE, outlier_sigma)
    if not judge(again).refused:
        return again
    shown = replace(held, free=again.free, fit=again.fit)
    return shown if judge(shown).refused else again


def _three_stages(lines: ImagePoints, pixel_mm: FloatArray | None) -> Chain:
    """The first two stages: angles from some directions, then distances. The caller refines all together."""
    directions = as_directions(lines.of_some_frames(SOME_FRAMES))
    chain = settled_angles(directions, _ratio(pixel_mm), hemisphere(), fit_ratio=pixel_mm is None)
    return _with_distances(lines, chain, pixel_mm)


def _one_stage(lines: ImagePoints, pixel_mm: FloatArray | None, probe: tuple[str, ...]) -> Chain:
    """The best solution for all parameters at once of some lines, from several mountings."""
    few = lines.of_some_frames(SOME_FRAMES)
    directions = as_directions(few)
    turns = directions.world_from_sensor.rotation
    starts = angle_starts(directions.pixels, turns, _ratio(pixel_mm), hemisphere())
    settled = [
        solve_chain(few, Plane(), _with_distances(few, start, pixel_mm), probe, outlier_sigma=np.inf)
        for start in starts
    ]
    return min(settled, key=lambda solution: solution.sigma).chain


def _ratio(pixel_mm: FloatArray | None) -> float:
    return 1.0 if pixel_mm is None else float(pixel_mm[0] / pixel_mm[1])


def _with_distances(lines: ImagePoints, angles: Chain, pixel_mm: FloatArray | None) -> Chain:
    """Second stage, for the image and its in-plane mirror, which distances tell apart."""
    turned = RigidTransform.from_rotation(in_plane_mirror(angles.sensor_from_image.rotation))
    mirror = replace(angles, sensor_from_image=turned)
    found = [distance_start(lines, either, pixel_mm) for either in (angles, mirror)]
    return min(found, key=lambda pair: pair[1])[0]


def settled_angles(
    lines: ImagePoints, ratio: float, normals: FloatArray, fit_ratio: bool = False, level: bool = False
) -> Chain:
    """First stage: find the angles that make line directions lie in the plane, robustly.

    Parameters
    ----------
    lines : ImagePoints
        With directions for pixels (`as_directions`).
    """
    phantom = LineDirections(np.array([ratio, 1.0]), level)
    free = ("s_x", *ANGLES, *phantom.determined) if fit_ratio else (*ANGLES, *phantom.determined)
    best, least = None, np.inf
    for start in angle_starts(lines.pixels, lines.world_from_sensor.rotation, ratio, normals):
        chain = first_guess(lines, phantom, start, free)
        sigma = sigma_of(residuals_of(lines, phantom, chain))
        agreed = abs(sigma - least) < _SAME * least
        if sigma < least:
            best, least = chain, sigma
        if agreed:
            break
    if best is None:
        raise InsufficientDataError("expected line directions that are finite, got others")
    return best


def facing_up(solution: ChainSolution) -> ChainSolution:
    """The same solution with the plane's normal on the probe's side: heights of images are positive."""
    target = solution.chain.target_from_world
    heights = solution.chain.target_from_image(solution.points).translation[:, 2]
    if np.median(heights) >= 0:
        return solution
    over = RigidTransform.from_rotation(Rotation.from_euler("x", np.pi))
    return replace(
        solution,
        chain=replace(solution.chain, target_from_world=over * target),
        residuals=-solution.residuals,
    )
