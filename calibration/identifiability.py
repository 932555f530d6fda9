"""Whether the motion of a scan determines the calibration, and which motions are missing.

To find the missing motions, more frames are imagined in which the probe is turned or shifted in the ways that
the scan has not. Missing are those without which the answer would stay uncertain, all others added.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.chain import CHAIN, ChainSolution, ImagePoints, residuals_and_jacobian
from calibration.motions import UP_AND_DOWN, Motion, absent, extents, on_phantom, with_motion
from calibration.near import corners_moved
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError

MAX_CONDITION = 1000.0
"""Robot calibration asks for 100 (TR 303, section 4.2); its bare-wall trials were at 211 and 448."""

_TWO_SIDED = 1.96
REFUSED_MM, REFUSED_RAD = 5.0 / _TWO_SIDED, np.deg2rad(5.0) / _TWO_SIDED
"""Standard error of the image's worst corner, and of its rotation about the worst axis, above which a
solution is refused: 95 % intervals of 5 mm and 5 degrees, which a ruler and a protractor on the probe
achieve."""

WEAK_MM, WEAK_RAD = 1.0, np.deg2rad(1.0)
"""Standard error of a weakly determined solution; 1 degree is the published precision (Housden 2008)."""

MISFIT_MM, MISFIT_RAD = 3.0, np.deg2rad(5.0)
"""Root mean square residual above which the phantom does not explain the images: the worst published is
3.5 mm as a distance, with early magnetic trackers (TR 303, section 5), 2 mm in each component."""

TIE = 25.0
"""Evidence (`Rival`) below which two answers are not told apart: five standard deviations."""

_TRIED_FRAMES = 12
_LEAST_SIGMA_MM, _LEAST_SIGMA_RAD = 0.1, np.deg2rad(0.1)
"""Lines are not found more exactly; residuals of exact data would make every motion look sufficient."""
_ALLOWED_LACKING = 0.65
"""Share of what is allowed where a motion is absent: the standard error is itself uncertain, and three of it
are to stay below 5 mm and 5 degrees."""
_LET_PASS = 2.0
"""Share of what is allowed that errors may reach, were residuals those of a phantom that fits, for a misfit
to be the phantom's."""
_HELPS, _MATTERS = 1.5, 0.5
"""A motion matters if without it the error stays as many times larger, and above this share of a weak one."""
_HELPS_LITTLE = 1.05
"""A motion helps at all if without it the error stays larger by a twentieth: less is rounding."""
_HOPELESS = 10.0
"""Error, as a multiple of a weak one, above which the answer does not even say where the image's axes are:
all motions that a scan of a plane has not are named."""
_INFLATION = 4.0
"""Most that errors that wander are taken to enlarge those of a scan in which nothing is missing."""

_UNKNOWN = 0.3
"""Standard deviation of a pixel size before anything is measured or given, as a share of it."""
_UNKNOWN_RAD, _UNKNOWN_MM = 1.0, 300.0


@dataclass(frozen=True)
class Adequacy:
    """How well the motion determines a calibration, if the phantom explains the images.

    Attributes
    ----------
    standard_error : float
        Of the image's worst corner, mm; of the rotation about its worst axis, rad, where only directions are
        known.
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


@dataclass(frozen=True)
class _Errors:
    """Standard errors of the image's worst corner, mm, and of its rotation about the worst axis, rad."""

    corner_mm: float
    angle_rad: float

    def of_limit(self, mm: float, rad: float) -> float:
        """The larger of both, as a share of what is allowed."""
        return max(self.corner_mm / mm, self.angle_rad / rad)


class InadequateError(InsufficientDataError):
    """A solution that is refused, with the reason.

    Attributes
    ----------
    solution : ChainSolution, optional
        Still a start for others; none once the error is shown with the name of what it came from.
    """

    def __init__(self, message: str, solution: ChainSolution | None = None) -> None:
        super().__init__(message)
        self.solution = solution


def require_adequate(solution: ChainSolution, verdict: Adequacy | None = None) -> ChainSolution:
    """Return `solution` if its motion was sufficient, as `judge` said if it was asked.

    Raises
    ------
    InadequateError
        Naming the missing motions, if the answer is too uncertain to be used, or another explains the images
        as well; or if the phantom does not explain the images.
    """
    found = verdict or judge(solution)
    if found.refused:
        raise InadequateError(found.verdict, solution)
    return solution


def judge(solution: ChainSolution) -> Adequacy:
    """Judge the motion of a solution, and whether the phantom explains the images at all.

    The image is taken to reach as far as the phantom was seen in it.
    """
    angular = solution.angular
    information = _information(solution, on_phantom(solution, solution.points_used))
    white = _errors(solution, _covariance(solution, information))
    claimed = _errors(solution, _full(solution, solution.covariance))
    errors = _Errors(
        0.0 if angular else max(white.corner_mm, claimed.corner_mm), max(white.angle_rad, claimed.angle_rad)
    )
    error = errors.angle_rad if angular else errors.corner_mm
    excess = errors.of_limit(REFUSED_MM, REFUSED_RAD)
    condition = solution.condition_number
    share = (MISFIT_RAD if angular else MISFIT_MM) / solution.rms if solution.rms > 0 else np.inf
    # Where even a phantom that fits would not determine the answer, the misfit comes from the motion: the
    # solver runs away in the direction left open.
    if share < 1 and share * white.of_limit(REFUSED_MM, REFUSED_RAD) <= _LET_PASS:
        misfit = (
            f"the phantom does not explain the images (they miss it by {_size(solution.rms, angular)}): do "
            "the images and the sensor readings belong together, and are the phantom, its wires and their "
            "numbers the ones named?"
        )
        return Adequacy(error, condition, (), True, misfit)
    tied = solution.rival is not None and solution.rival.evidence < TIE
    lacking = absent(solution)
    # Dots of wires tell the image's place from a few frames; what they lack is in their errors.
    allowed = _ALLOWED_LACKING if lacking and solution.phantom.seen_as != "dot" else 1.0
    # Of a plane always equally deep, errors in the poses shrink free pixels, more than any error claimed.
    unsized = _pixels_unknown(solution) and UP_AND_DOWN in lacking
    refused = bool(excess > allowed or not condition <= MAX_CONDITION or tied or unsized)
    weak = errors.of_limit(WEAK_MM, WEAK_RAD) > 1
    missing: list[Motion] = []
    if weak or refused:
        scale = errors.of_limit(WEAK_MM, WEAK_RAD) / white.of_limit(WEAK_MM, WEAK_RAD)
        missing = _uncertain(solution, information, min(max(scale, 1.0), _INFLATION) ** 2)
    if unsized and UP_AND_DOWN not in missing:
        missing.append(UP_AND_DOWN)
    if tied:
        missing += [motion for motion in _telling(solution) if motion not in missing]
    where = "" if angular else " at the image's corners"
    state = f"standard error {_size(error, angular)}{where}"
    if not angular and errors.angle_rad / REFUSED_RAD > errors.corner_mm / REFUSED_MM:
        state += f" and {_size(errors.angle_rad, True)}"
    state += f", condition number {condition:.3g}"
    if missing:
        advice = "; and ".join(motion.advice for motion in missing)
    elif solution.phantom.seen_as == "dot" and (not weak or not condition <= MAX_CONDITION):
        # No motion would help.
        advice = "what stays unknown is where the phantom is: show more of it, all its wires"
    else:
        advice = "record more frames over a wider range"
    if tied and excess <= allowed:
        verdict = f"two answers explain the images equally well, one of them mirrored ({state}): {advice}"
    elif refused:
        verdict = f"the motion does not determine the calibration ({state}): {advice}"
    elif weak:
        verdict = f"the motion determines the calibration weakly ({state}): {advice}"
    else:
        verdict = f"the motion was sufficient ({state})"
    return Adequacy(error, condition, tuple(motion.advice for motion in missing), refused, verdict)


def _pixels_unknown(solution: ChainSolution) -> bool:
    """Whether a plane alone is to tell the pixel size."""
    return solution.phantom.seen_as == "line" and solution.prior is None and "s_x" in solution.free


def _size(error: float, angular: bool) -> str:
    return f"{np.rad2deg(error):.2g} degrees" if angular else f"{error:.2g} mm"


def _information(solution: ChainSolution, near: ImagePoints) -> FloatArray:
    """Inverse covariance that points (`on_phantom`) bring to the free parameters, were errors independent."""
    _, jacobian = _near_jacobian(solution, near, solution.chain.pixel_mm)
    least = _LEAST_SIGMA_RAD if solution.angular else _LEAST_SIGMA_MM
    return np.asarray(jacobian.T @ jacobian / max(solution.sigma, least) ** 2)


def _near_jacobian(
    solution: ChainSolution, near: ImagePoints, pixel_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    origin = np.concatenate([pixel_mm, np.zeros(len(CHAIN) - 2)])
    residuals, jacobian = residuals_and_jacobian(origin, near, solution.phantom)
    return residuals.ravel(), jacobian.reshape(-1, len(CHAIN))[:, solution.free_columns]


def _covariance(solution: ChainSolution, information: FloatArray) -> FloatArray:
    """Covariance of `CHAIN` from this information, and what is known before."""
    return _full(solution, np.asarray(np.linalg.inv(information + np.diag(_plausible(solution)))))


def _full(solution: ChainSolution, covariance: FloatArray) -> FloatArray:
    """Covariance of the free parameters among those of `CHAIN`."""
    full = np.zeros((len(CHAIN), len(CHAIN)))
    full[np.ix_(solution.free_columns, solution.free_columns)] = covariance
    return full


def _errors(solution: ChainSolution, covariance: FloatArray) -> _Errors:
    angle = float(np.sqrt(np.linalg.eigvalsh(covariance[5:8, 5:8])[-1]))
    if solution.angular:
        return _Errors(0.0, angle)
    moved = corners_moved(solution.chain, solution.points_used)
    corners = np.einsum("kip,pq,kiq->k", moved, covariance, moved)
    return _Errors(float(np.sqrt(corners.max())), angle)


def _plausible(solution: ChainSolution) -> FloatArray:
    """Inverse variance of each free parameter before anything is measured."""
    size = solution.chain.pixel_mm * _UNKNOWN
    if solution.prior is not None:
        size = solution.prior.pixel_mm * solution.prior.error
    known = dict(zip(CHAIN[:2], size, strict=True))
    widths = [
        float(known[name]) if name in known else _UNKNOWN_MM if name[0] in "xyz" else _UNKNOWN_RAD
        for name in solution.free
    ]
    return np.array(widths) ** -2.0


def _uncertain(solution: ChainSolution, information: FloatArray, inflation: float) -> list[Motion]:
    """Motions without which the answer would stay uncertain, the most helpful first.

    Parameters
    ----------
    inflation : float
        Variance of the answer over that from independent errors of the same size.
    """
    near = on_phantom(solution, solution.points_used.of_some_frames(_TRIED_FRAMES))
    share = len(solution.points_used.frames) / len(near.frames) / 2.0

    def error(motions: Sequence[Motion]) -> float:
        more = [share * _information(solution, with_motion(solution, near, one)) for one in motions]
        found = _errors(solution, _covariance(solution, (information + sum(more)) / inflation))
        return found.of_limit(WEAK_MM, WEAK_RAD)

    return _needed(solution, error)


def _needed(solution: ChainSolution, error: Callable[[Sequence[Motion]], float]) -> list[Motion]:
    """Of the motions that a scan has not, those without which its error would stay larger.

    If none of them is, the one that helps at all; if none is absent, that which helps most: it was there, and
    not far enough.
    """
    lacking = absent(solution)
    least, now = error(lacking), error([])
    if now > _HOPELESS and solution.phantom.seen_as != "dot":
        return lacking
    without = {one: error([other for other in lacking if other is not one]) for one in lacking}
    needed = [one for one in lacking if without[one] > max(_HELPS * least, _MATTERS)]
    needed.sort(key=lambda one: -without[one])
    # Of several that would do, those that help most.
    while len(needed) < len(lacking) and error(needed) > max(_HELPS * least, _MATTERS):
        others = [one for one in lacking if one not in needed]
        needed.append(min(others, key=lambda one: error([*needed, one])))
    if needed:
        # And those that would have helped, had they been there instead.
        others = [one for one in lacking if one not in needed and solution.phantom.seen_as != "dot"]
        also = [one for one in others if _HELPS * error([one]) < now]
        return [*needed, *also]
    some = [one for one in lacking if without[one] > _HELPS_LITTLE * least] or list(extents(solution))
    best = min(some, key=lambda one: error([one]))
    return [best] if best in lacking or now > _HELPS * error([best]) else []


def _telling(solution: ChainSolution) -> list[Motion]:
    """Motions that would tell a solution from its rival."""
    if solution.rival is None:
        return []
    rival, points = solution.rival.chain, solution.points_used
    near = on_phantom(solution, points.of_some_frames(_TRIED_FRAMES))
    back = solution.chain.target_from_world.inv()
    image = solution.chain.sensor_from_image.inv()

    def agreement(motions: Sequence[Motion]) -> float:
        sets = [near, *(with_motion(solution, near, one) for one in motions)]
        rows, wanted = [], []
        for one in sets:
            poses = rival.target_from_world * back * one.world_from_sensor * image * rival.sensor_from_image
            seen = ImagePoints(one.pixels, one.frame, poses, one.wire)
            residuals, jacobian = _near_jacobian(solution, seen, rival.pixel_mm)
            rows.append(jacobian)
            wanted.append(residuals)
        matrix, values = np.vstack(rows), np.concatenate(wanted)
        known = np.diag(np.sqrt(_plausible(solution))) * solution.sigma
        step = np.linalg.lstsq(np.vstack([matrix, known]), -np.append(values, np.zeros(len(known))))[0]
        left = float(np.sqrt(np.mean((values + matrix @ step) ** 2)))
        return solution.sigma / max(left, 1e-3 * solution.sigma)

    return _needed(solution, agreement)
