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

from calibration.alternatives import apart, best_solution
from calibration.chain import (
    ANGLES,
    PROBE,
    Chain,
    ChainSolution,
    ImagePoints,
    Phantom,
    PixelPrior,
    SeenAs,
    as_directions,
)
from calibration.identifiability import Adequacy, judge, require_adequate
from calibration.solver import (
    OUTLIER_SIGMA,
    SOME_FRAMES,
    first_guess,
    probe_parameters,
    residuals_of,
)
from calibration.starts import angle_starts, distance_start, hemisphere, in_plane_mirror
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError

_FEWEST_LINES = 6
"""Two equations each: the fewest for eleven unknowns."""

_PIXEL_MM = 0.15
"""Pixel size of an image some hundred pixels high and some centimetres deep, if none is given."""

_BEGINNING = 2
"""Rounds after which starts that have met go on as one."""
_HOPELESS = 3.0
"""Ends of iterations whose mean absolute residual is as many times the least are not looked at again."""
_TRIED = 3
"""Angles that are followed to the end."""
PIXEL_ERROR = 0.02
"""Standard error of a pixel size from a scanner's calipers, as a share of it: of distances they show."""
_CONTRADICTS = 3.0
"""Standard errors by which lines must move the pixel size given for it to be doubted."""

Stages = Literal["three", "one"]


@dataclass(frozen=True)
class Plane:
    """A plane at z = 0 of its own frame: one equation for each point (TR 303, equation 8)."""

    determined: tuple[str, ...] = ("z_c", "beta_c", "gamma_c")
    seen_as: SeenAs = "line"
    kept_in_plane: bool = False

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
    kept_in_plane: bool = False

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
    pixel_error: float = PIXEL_ERROR,
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
    pixel_error : float
        Standard error of the pixel size given, as a share of it; infinite if it is a guess.

    Raises
    ------
    InsufficientDataError
        If there are too few lines, they contradict each other or the pixel size, or the motion does not
        determine the answer; then the missing motions are named.
    """
    if len(lines) < 2 * _FEWEST_LINES:
        raise InsufficientDataError(
            f"expected lines in at least {_FEWEST_LINES} frames, got {len(lines) // 2}"
        )
    if not pixel_error > 0:
        raise InvalidInputError(f"pixel_error: expected a positive share, got {pixel_error:g}")
    probe, held = probe_parameters(fit_pixels, pixel_mm)
    prior = None
    if fit_pixels and pixel_mm is not None and np.isfinite(pixel_error):
        prior = PixelPrior(np.asarray(pixel_mm, dtype=float), pixel_error)
    solution, verdict = _solved(lines, held, prior, stages, probe, outlier_sigma)
    if prior is not None and np.abs(prior.deviation(solution.chain.pixel_mm)).max() > _CONTRADICTS:
        solution, verdict = _without_prior(lines, solution, stages, outlier_sigma), None
    return facing_up(require_adequate(solution, verdict))


def _solved(
    lines: ImagePoints,
    held: FloatArray | None,
    prior: PixelPrior | None,
    stages: Stages,
    probe: tuple[str, ...],
    outlier_sigma: float,
) -> tuple[ChainSolution, Adequacy | None]:
    """The best solution, and the verdict on it if it was asked for."""
    given = held if prior is None else prior.pixel_mm
    starts = _one_stage(lines, given) if stages == "one" else _three_stages(lines, given)
    found = best_solution(lines, Plane(), starts, probe, outlier_sigma, prior)
    verdict = None if given is not None or stages == "one" else judge(found)
    if verdict is None or not verdict.refused:
        return found, verdict
    # Free pixels may shrink to nothing on the way where the motion is poor.
    also = _three_stages(lines, np.full(2, _PIXEL_MM))
    return best_solution(lines, Plane(), [found.chain, *also], probe, outlier_sigma), None


def _without_prior(
    lines: ImagePoints, solution: ChainSolution, stages: Stages, outlier_sigma: float
) -> ChainSolution:
    """Believe lines that contradict the pixel size given if they determine it by themselves.

    Raises
    ------
    InsufficientDataError
        If they do not.
    """
    alone, found_so = _solved(lines, None, None, stages, PROBE, outlier_sigma)
    verdict = found_so or judge(alone)
    if not verdict.refused:
        return alone
    if judge(solution).refused or solution.prior is None:
        return solution
    given, found = solution.prior.pixel_mm, solution.chain.pixel_mm
    raise InsufficientDataError(
        f"expected lines that agree with pixels of {given[0]:.4g} x {given[1]:.4g} mm to "
        f"{100 * solution.prior.error:g} %, got {found[0]:.4g} x {found[1]:.4g} mm with them, and without "
        f"them {verdict.verdict}"
    )


def _three_stages(lines: ImagePoints, pixel_mm: FloatArray | None) -> list[Chain]:
    """The first two stages: angles from some directions, then distances. The caller refines all together."""
    directions = as_directions(lines.of_some_frames(SOME_FRAMES))
    found = settled_angles(directions, _ratio(pixel_mm), hemisphere(), fit_ratio=pixel_mm is None)
    return [_with_distances(lines, angles, pixel_mm) for angles in found[:_TRIED]]


def _one_stage(lines: ImagePoints, pixel_mm: FloatArray | None) -> list[Chain]:
    """Starts of all parameters at once, from several mountings."""
    few = lines.of_some_frames(SOME_FRAMES)
    directions = as_directions(few)
    turns = directions.world_from_sensor.rotation
    starts = angle_starts(directions.pixels, turns, _ratio(pixel_mm), hemisphere())
    return [_with_distances(few, start, pixel_mm) for start in starts]


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
) -> list[Chain]:
    """First stage: find the angles that make line directions lie in the plane, robustly.

    Parameters
    ----------
    lines : ImagePoints
        With directions for pixels (`as_directions`).

    Returns
    -------
    list of Chain
        Where iterations end, the one that leaves least first; those that leave more than the best by a
        factor of `_HOPELESS` are left out.
    """
    phantom = LineDirections(np.array([ratio, 1.0]), level)
    free = ("s_x", *ANGLES, *phantom.determined) if fit_ratio else (*ANGLES, *phantom.determined)
    starts = angle_starts(lines.pixels, lines.world_from_sensor.rotation, ratio, normals)
    if not starts:
        raise InsufficientDataError("expected line directions that are finite, got others")
    begun = [first_guess(lines, phantom, start, free, rounds=_BEGINNING) for start in starts]
    # Few starts are left, for most meet on the way.
    settled = [first_guess(lines, phantom, start, free) for start in _different(lines, phantom, begun)]
    return _different(lines, phantom, settled, _HOPELESS)


def _different(
    lines: ImagePoints, phantom: Phantom, chains: list[Chain], hopeless: float = np.inf
) -> list[Chain]:
    """Those that are not one answer, the one that leaves least first, and none that leaves far more."""
    left = [float(np.abs(residuals_of(lines, phantom, chain)).mean()) for chain in chains]
    found: list[Chain] = []
    for k in np.argsort(left):
        alike = any(not apart(other, chains[k], lines, phantom) for other in found)
        if not alike and left[k] <= hopeless * min(left):
            found.append(chains[k])
    return found


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
