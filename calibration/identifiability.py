"""Whether the motion of a scan determines the calibration, and which motion is missing.

To find the missing motion, more frames are imagined in which the probe is turned or shifted in one more way;
missing is the motion whose frames would make the answer most certain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.chain import CHAIN, ChainSolution, ImagePoints, residuals_and_jacobian
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import skew

MAX_CONDITION = 1000.0
"""Robot calibration asks for 100 (TR 303, section 4.2); its bare-wall trials were at 211 and 448."""

REFUSED_MM, REFUSED_RAD = 5.0, np.deg2rad(2.0)
"""Standard error of the image's corners, or of an orientation sensor's rotation, above which a solution is
refused: what a ruler and a protractor on the probe achieve."""

WEAK_MM, WEAK_RAD = 1.0, np.deg2rad(1.0)
"""Standard error of a weakly determined solution; 1 degree is the published precision (Housden 2008)."""

MISFIT_MM, MISFIT_RAD = 3.0, np.deg2rad(5.0)
"""Root mean square residual above which the phantom does not explain the images: the worst published is
3.5 mm as a distance, with early magnetic trackers (TR 303, section 5), 2 mm in each component."""

SMALLEST_IMAGE_MM = 1.0
"""Smallest plausible image. Where the probe was only turned about a point of the image, pixels shrink to
nothing: an image that is one point is at the same height in all frames."""

_TURN_RAD, _SHIFT_MM = np.deg2rad(15.0), 10.0
_TRIED_FRAMES = 12
_LEAST_SIGMA_MM, _LEAST_SIGMA_RAD = 0.1, np.deg2rad(0.1)
"""Lines are not found more exactly; residuals of exact data would make every motion look sufficient."""

_UNKNOWN = {"s_x": 0.3, "s_y": 0.3}
"""Standard deviation of a parameter before anything is measured; of pixel sizes, as a share of them."""
_UNKNOWN_RAD, _UNKNOWN_MM = 1.0, 300.0


@dataclass(frozen=True)
class Motion:
    """A way to move the probe: turn about, or shift along, one of the image's axes."""

    advice: str
    axis: int
    turns: bool


_UP_AND_DOWN = Motion("move the probe up and down (the phantom then appears at other depths)", 1, False)
_SHRUNK = "the motion does not determine the pixel size"

MOTIONS = (
    Motion("tilt the probe to and fro (rotate about the image's lateral axis)", 0, True),
    Motion("rotate about the beam axis", 1, True),
    Motion("roll the probe from side to side (rotate about the elevational axis)", 2, True),
    Motion("shift the probe sideways (the phantom then appears elsewhere across the image)", 0, False),
    _UP_AND_DOWN,
)


@dataclass(frozen=True)
class Adequacy:
    """How well the motion determines a calibration, if the phantom explains the images.

    Attributes
    ----------
    standard_error : float
        Of the image's corners, root mean square, mm; of the rotation about its worst axis, rad, where only
        directions are known.
    condition_number : float
        Of the scaled Jacobian, in frames on the image and the phantom.
    missing : tuple of str
        Motions, most useful first; none if the answer is certain enough.
    """

    standard_error: float
    condition_number: float
    missing: tuple[str, ...]
    refused: bool
    verdict: str


def require_adequate(solution: ChainSolution) -> ChainSolution:
    """Return `solution` if its motion was sufficient.

    Raises
    ------
    InsufficientDataError
        Naming the missing motion, if the answer is too uncertain to be used; or if the phantom does not
        explain the images.
    """
    found = judge(solution)
    if found.refused:
        raise InsufficientDataError(found.verdict)
    return solution


def judge(solution: ChainSolution) -> Adequacy:
    """Judge the motion of a solution, and whether the phantom explains the images at all.

    The image is taken to reach as far as the phantom was seen in it.
    """
    angular = solution.angular
    weak, limit = (WEAK_RAD, REFUSED_RAD) if angular else (WEAK_MM, REFUSED_MM)
    information = _information(solution, _on_phantom(solution, solution.points_used))
    error = _standard_error(solution, information)
    condition = solution.fit.condition_number
    share = (MISFIT_RAD if angular else MISFIT_MM) / solution.rms if solution.rms > 0 else np.inf
    # Where even a phantom that fits would not determine the answer, the misfit comes from the motion: the
    # solver runs away in the direction left open.
    if share < 1 and share * error <= limit:
        misfit = (
            f"the phantom does not explain the images (they miss it by {_size(solution.rms, angular)}): do "
            "the images and the sensor readings belong together, and are the phantom, its wires and their "
            "numbers the ones named?"
        )
        return Adequacy(error, condition, (), True, misfit)
    right_down_mm = solution.points_used.pixels.max(axis=0) * solution.chain.pixel_mm
    if not angular and right_down_mm.min() < SMALLEST_IMAGE_MM:
        return Adequacy(error, condition, (_UP_AND_DOWN.advice,), True, f"{_SHRUNK}: {_UP_AND_DOWN.advice}")
    refused = bool(error > limit or not condition <= MAX_CONDITION)
    missing = tuple(_missing(solution, information, weak)) if error > weak else ()
    where = "" if angular else " at the image's corners"
    state = f"standard error {_size(error, angular)}{where}, condition number {condition:.3g}"
    if missing:
        advice = "; and ".join(missing)
    elif solution.phantom.seen_as == "dot" and error <= weak:
        # No motion would help.
        advice = "what stays unknown is where the phantom is: show more of it, all its wires"
    else:
        advice = "record more frames over a wider range"
    if refused:
        verdict = f"the motion does not determine the calibration ({state}): {advice}"
    elif error > weak:
        verdict = f"the motion determines the calibration weakly ({state}): {advice}"
    else:
        verdict = f"the motion was sufficient ({state})"
    return Adequacy(error, condition, missing, refused, verdict)


def _size(error: float, angular: bool) -> str:
    return f"{np.rad2deg(error):.2g} degrees" if angular else f"{error:.2g} mm"


def _on_phantom(solution: ChainSolution, points: ImagePoints) -> ImagePoints:
    """Points whose sensor is at the image and whose world is the phantom: all angles to be found are zero."""
    return replace(points, world_from_sensor=solution.chain.target_from_image(points))


def _information(solution: ChainSolution, near: ImagePoints) -> FloatArray:
    """Inverse covariance that points (`_on_phantom`) bring to the free parameters."""
    origin = np.concatenate([solution.chain.pixel_mm, np.zeros(len(CHAIN) - 2)])
    _, jacobian = residuals_and_jacobian(origin, near, solution.phantom)
    matrix = jacobian.reshape(-1, len(CHAIN))[:, solution.free_columns]
    least = _LEAST_SIGMA_RAD if solution.angular else _LEAST_SIGMA_MM
    return np.asarray(matrix.T @ matrix / max(solution.sigma, least) ** 2)


def _standard_error(solution: ChainSolution, information: FloatArray) -> float:
    """Standard error of the corners, mm, or of the worst angle, rad, from this information alone."""
    covariance = np.zeros((len(CHAIN), len(CHAIN)))
    columns = solution.free_columns
    covariance[np.ix_(columns, columns)] = np.linalg.inv(information + np.diag(_plausible(solution)))
    if solution.angular:
        return float(np.sqrt(np.linalg.eigvalsh(covariance[5:8, 5:8])[-1]))
    right, bottom = solution.points_used.pixels.max(axis=0)
    corners_px = np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])
    flat = np.column_stack([corners_px * solution.chain.pixel_mm, np.zeros(len(corners_px))])
    moved = np.zeros((len(corners_px), 3, len(CHAIN)))
    moved[:, 0, 0], moved[:, 1, 1] = corners_px.T
    moved[:, :, 2:5] = np.eye(3)
    moved[:, :, 7:4:-1] = -skew(flat)
    return float(np.sqrt(np.mean(np.einsum("kip,pq,kiq->k", moved, covariance, moved))))


def _plausible(solution: ChainSolution) -> FloatArray:
    """Inverse variance of each free parameter before anything is measured."""
    sizes = dict(zip(CHAIN[:2], solution.chain.pixel_mm, strict=True))
    widths = [
        _UNKNOWN[name] * float(sizes[name])
        if name in _UNKNOWN
        else _UNKNOWN_MM
        if name[0] in "xyz"
        else _UNKNOWN_RAD
        for name in solution.free
    ]
    return np.array(widths) ** -2.0


def _missing(solution: ChainSolution, information: FloatArray, enough: float) -> Iterator[str]:
    """Motions, the most helpful first, until the answer would be certain enough."""
    known, error = information, _standard_error(solution, information)
    candidates = list(MOTIONS)
    while candidates and error > enough:
        added = [known + _imagined(solution, motion) for motion in candidates]
        errors = [_standard_error(solution, sum_) for sum_ in added]
        best = int(np.argmin(errors))
        if errors[best] > 0.8 * error:
            return
        known, error = added[best], errors[best]
        yield candidates.pop(best).advice


def _imagined(solution: ChainSolution, motion: Motion) -> FloatArray:
    """Information of as many frames again, with the probe moved in one more way."""
    if not motion.turns and solution.angular:
        return np.zeros((len(solution.free), len(solution.free)))
    near = _on_phantom(solution, solution.points_used.of_some_frames(_TRIED_FRAMES))
    moved = _turned if motion.turns else _shifted
    share = len(solution.points_used.frames) / len(near.frames) / 2.0
    steps = [moved(solution, near, np.eye(3)[motion.axis] * sign) for sign in (-1.0, 1.0)]
    return np.asarray(share * sum(_information(solution, step) for step in steps))


def _shifted(solution: ChainSolution, near: ImagePoints, axis: FloatArray) -> ImagePoints:
    """The image shifted along itself, so that the same points of the phantom appear elsewhere in it."""
    shift = RigidTransform.from_translation(_SHIFT_MM * axis)
    pixels = near.pixels - _SHIFT_MM * axis[:2] / solution.chain.pixel_mm
    return replace(near, pixels=pixels, world_from_sensor=near.world_from_sensor * shift)


def _turned(solution: ChainSolution, near: ImagePoints, axis: FloatArray) -> ImagePoints:
    """The image turned about its dot, or about the middle of its line, which then runs elsewhere."""
    turn = Rotation.from_rotvec(_TURN_RAD * axis)
    seen, size = solution.phantom.seen_as, solution.chain.pixel_mm
    if seen == "dot":
        return _about(near, near.pixels * size, turn, near.pixels)
    up = near.turns[:, 2] @ turn.as_matrix()
    along = np.column_stack([-up[:, 1], up[:, 0]])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    if seen == "direction":
        return _about(near, np.zeros_like(near.pixels), turn, along / size)
    ends = (near.pixels * size).reshape(-1, 2, 2)
    middle = np.repeat(ends.mean(axis=1), 2, axis=0)
    half = np.repeat(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / 2.0, 2)
    sign = np.tile([-1.0, 1.0], len(ends))
    return _about(near, middle, turn, (middle + (sign * half)[:, None] * along) / size)


def _about(near: ImagePoints, centre_mm: FloatArray, turn: Rotation, pixels: FloatArray) -> ImagePoints:
    centre = np.column_stack([centre_mm, np.zeros(len(centre_mm))])
    step = RigidTransform.from_components(centre - turn.apply(centre), turn)
    return replace(near, pixels=pixels, world_from_sensor=near.world_from_sensor * step)
