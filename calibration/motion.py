"""Test whether a scan's motion determines a calibration, and name missing motions.

References
----------
.. [1] R. W. Prager et al., CUED/F-INFENG/TR 303, 1997, section 4.2 (condition number of the scaled Jacobian).
.. [2] P.-W. Hsu et al., "Rapid, easy and reliable calibration for freehand 3D ultrasound", Ultrasound Med.
Biol.
   32, 2006 (reliability from its eigenvectors).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.points import ANGLES, PROBE, SCALES, columns_of, in_chain
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError

if TYPE_CHECKING:
    from calibration.solution import Solution

MAX_CONDITION = 1000.0
"""Robot calibration asks for 100 (TR 303, section 4.2); its bare-wall trials were at 211 and 448."""
_HALF_WIDTH = 1.96
LIMITS = np.array([5.0, np.deg2rad(5.0)]) / _HALF_WIDTH
"""Standard error of the image's worst corner, and about its worst axis, above which a solution is refused:
95 % intervals of 5 mm and 5 degrees, which a ruler and a protractor on the probe achieve."""
WEAK = np.array([1.0, np.deg2rad(1.0)])
"""Standard error of a weakly determined solution; 1 degree is the published precision (Housden 2008)."""
MISFIT = np.array([3.0, np.deg2rad(5.0)])
"""Root mean square residual above which the phantom does not explain the images: the worst published is 3.5
mm as a distance, with early magnetic trackers (TR 303, section 5), 2 mm in each component."""
TIE = 25.0
"""Evidence of a rival below which two answers are not told apart: five standard deviations."""

_LEAST_SIGMA = np.array([0.1, np.deg2rad(0.1)])
"""Lines are not found more exactly; residuals of exact data would make every motion look sufficient."""
_LIMIT_LACKING = 0.65
"""Share of `LIMITS` that counts where a motion is absent: the standard error is itself uncertain, and three
of it are to stay below 5 mm and 5 degrees."""
_LET_PASS = 2.0
"""Share of `LIMITS` that errors may reach, were residuals those of a phantom that fits, for a misfit
to be the phantom's."""
_UNKNOWN, _UNKNOWN_RAD, _UNKNOWN_MM = 0.3, 1.0, 300.0
"""Standard deviations before anything is measured: of a pixel size as a share of it, of angles and places."""

_STEP_RAD, _SHIFT, _LEAST_SHIFT_MM = np.deg2rad(15.0), 0.2, 8.0
"""A motion on purpose: by this angle, or by this share of the image, at least so many millimetres, to
either side."""
_ABSENT = 0.25
"""Standard deviation, over such a step, below which a motion is absent: a hand that means to hold still
wobbles by 0.7 to 1.4 degrees, one that moves on purpose by five."""
OBLONG = 3.0
"""Pixels found to be so oblong are taken for square: their shape was not determined."""

TILT = "tilt the probe to and fro (rotate about the image's lateral axis)"
YAW = "rotate about the beam axis"
ROLL = "roll the probe from side to side (rotate about the elevational axis)"
SIDEWAYS = "shift the probe sideways (the phantom then appears elsewhere across the image)"
UP_AND_DOWN = "move the probe up and down (the phantom then appears at other depths)"
MOTIONS = (TILT, YAW, ROLL, SIDEWAYS, UP_AND_DOWN)

DOUBTS = (
    "do images and readings belong together (one clock, one order, right-handed, in mm), did phantom and "
    "sensor stay where they were, and are the phantom, its wires and their numbers the ones named?"
)
_WORDS = (
    "the distance between columns", "the distance between rows",
    "the image's place across the beam", "the image's place along the beam", "the image's place out of plane",
    "roll", "yaw", "tilt",
)  # fmt: skip
"""The parameters of `PROBE` in messages."""


@dataclass(frozen=True)
class Adequacy:
    """Adequacy of a scan's motion: standard error, missing motions, verdict.

    Attributes
    ----------
    standard_error : float
        Of the image's worst corner, mm; about its worst axis, rad, where only directions are known.
    missing : tuple of str
        Motions that would help, or a doubt about the data; none if the answer is certain enough.
    """

    standard_error: float
    missing: tuple[str, ...]
    refused: bool
    verdict: str


class InadequateError(InsufficientDataError):
    """A solution that is refused, with the reason.

    Attributes
    ----------
    solution : Solution, optional
        Still a start for others; none once the error is shown with the name of what it came from.
    """

    def __init__(self, message: str, solution: Solution | None = None) -> None:
        super().__init__(message)
        self.solution = solution


def require_adequate(solution: Solution, pixel_mm: FloatArray | None = None) -> Solution:
    """Return `solution` if its motion was sufficient.

    Parameters
    ----------
    pixel_mm : ndarray, shape (2,), optional
        Pixel size as the images have it, roughly.

    Raises
    ------
    InadequateError
        Naming the missing motions, if the answer is too uncertain to be used, or another explains the
        images as well; or if the phantom does not explain the images, or readings have another unit.
    """
    size = solution.chain.pixel_mm
    if pixel_mm is not None and np.abs(np.log(size / pixel_mm)).max() > np.log(OBLONG):
        sizes = f"pixels of {size.mean():.2g} mm where the images have {np.mean(pixel_mm):.2g}"
        raise InadequateError(f"expected readings of the images' scale, got {sizes}: {DOUBTS}", solution)
    if solution.adequacy.refused:
        raise InadequateError(solution.adequacy.verdict, solution)
    return solution


def judge(solution: Solution) -> Adequacy:
    """Judge the motion of a solution, and whether the phantom explains the images at all."""
    angular, condition = solution.angular, solution.condition_number
    independent = _independent_covariance(solution)
    white = _errors(solution, independent)
    errors = np.maximum(white, _errors(solution, solution.full_covariance))
    excess, weak = float((errors / LIMITS).max()), bool((errors > WEAK).any())
    error = float(errors[int(angular)])
    rms, usual = solution.rms, WEAK[int(angular)]
    # Where residuals of the usual size would not determine the answer, the misfit comes from the motion: the
    # solver runs away in the direction left open.
    if rms > MISFIT[int(angular)] and usual / rms * float((white / LIMITS).max()) <= _LET_PASS:
        misfit = f"the phantom does not explain the images (they miss it by {_size(rms, angular)}): {DOUBTS}"
        return Adequacy(error, (), True, misfit)
    ambiguous = solution.evidence < TIE
    extent_of = extents(solution)
    lacking = [motion for motion, extent in extent_of.items() if extent < _ABSENT]
    dots = solution.phantom.seen_as == "dot"
    # Dots of wires tell the image's place from a few frames; what they lack is in their errors.
    limit = _LIMIT_LACKING if lacking and not dots else 1.0
    # Of a plane always equally deep, errors in the poses shrink free pixels, more than any error claimed.
    no_size = not dots and UP_AND_DOWN in lacking and "s_x" in solution.free
    no_size &= solution.prior.known_pixel_mm is None
    inadequate = bool(excess > limit or not condition <= MAX_CONDITION or ambiguous or no_size)
    noisy = rms > usual and not lacking
    missing = tuple(lacking) if weak or inadequate else ()
    doubt = f"the images miss the phantom by {_size(rms, angular)} (RMS); {DOUBTS}"
    if (weak or inadequate) and not lacking:
        missing = (doubt if noisy else min(extent_of, key=extent_of.__getitem__),)
    state = f"standard error {_size(error, angular)}" + ("" if angular else " at the image's corners")
    if not angular and np.argmax(errors / LIMITS) == 1:
        state += f" and {_size(errors[1], True)}"
    state += f", condition number {condition:.3g}"
    verdict = "the motion was sufficient"
    if ambiguous and excess <= limit:
        verdict = "two answers explain the images equally well, one of them mirrored"
    elif inadequate or weak:
        cause = "with residuals so large, the motion" if noisy else "the motion"
        verdict = f"{cause} {'does not determine' if inadequate else 'weakly determines'} the calibration"
    verdict += f" ({state})"
    if missing:
        deviations = np.sqrt(np.maximum(np.diag(independent), np.diag(solution.full_covariance)))
        verdict += f". Least certain is {least_certain(solution, deviations)}: {'; and '.join(missing)}"
        verdict += "" if lacking or noisy else f". If you did, {doubt}"
    verdict += f"; {solution.assumed}" if solution.assumed else ""
    return Adequacy(error, missing, inadequate, verdict)


def least_certain(solution: Solution, deviations: FloatArray) -> str:
    """The parameter of the image known least, with its 95 % interval, in words.

    Parameters
    ----------
    deviations : ndarray, shape (14,)
        Standard errors of `CHAIN`; a pixel size counts by how far it moves the image's far side.
    """
    halves, reach = _HALF_WIDTH * deviations[: len(PROBE)], solution.points_used.pixels.max(axis=0)
    worst = int(np.argmax(halves * np.concatenate([reach, np.ones(3), np.full(3, WEAK[0] / WEAK[1])])))
    if worst < len(SCALES):
        size = f"{100 * halves[worst] / solution.chain.pixel_mm[worst]:.2g} %"
    else:
        size = _size(halves[worst], PROBE[worst] in ANGLES)
    return f"{_WORDS[worst]}, +- {size} (95 %)"


def extents(solution: Solution) -> dict[str, float]:
    """Extent of each motion in a scan, relative to a deliberate motion.

    Lines tell roll and depth by themselves, and the sensor alone tells how far the plane's normal moved in
    its frame: the mounting, which is not known well where a motion is missing, hardly enters. Motions that
    cannot help are left out: a plane whose lines have a place looks the same from every side.
    """
    points, size = solution.points_used, solution.chain.pixel_mm
    steps_mm = np.maximum(_SHIFT * points.pixels.max(axis=0) * size, _LEAST_SHIFT_MM)
    if solution.phantom.seen_as == "dot":
        turns = solution.chain.target_from_image(points).rotation
        spread = (turns.mean().inv() * turns).as_rotvec().std(axis=0) / _STEP_RAD
        return dict(zip(MOTIONS, [*spread, *(points.pixels * size).std(axis=0) / steps_mm], strict=True))
    up = points.turns.transpose(0, 2, 1) @ solution.chain.target[2, :3]
    middle = up.mean(axis=0) / np.linalg.norm(up.mean(axis=0))
    swing = float(np.sum((up - np.outer(up @ middle, middle)).var(axis=0)))
    if solution.prior.known_pixel_mm is not None:
        size = solution.prior.pixel_mm
    elif "s_x" in solution.free and not 1.0 / OBLONG < size[0] / size[1] < OBLONG:
        size = np.full(2, size[1])
    ends = (points.pixels * size).reshape(-1, 1 if solution.angular else 2, 2)
    along = ends[:, 0] if solution.angular else ends[:, 1] - ends[:, 0]
    slope = np.arctan(along[:, 1] / along[:, 0])
    # The slope depends on the pixels' shape, which may be wrong; the normal swings as far at least.
    spread_of = {TILT: np.sqrt(max(swing - slope.var(), 0.0)), ROLL: min(slope.std(), np.sqrt(swing))}
    if solution.angular and solution.phantom.unknowns:
        # A plane that is not known to be level has a slope, which turning about its normal tells apart.
        turns = points.world_from_sensor.rotation
        spread_of[YAW] = ((turns.mean().inv() * turns).as_rotvec() @ middle).std()
    spread_of = {motion: float(angle / _STEP_RAD) for motion, angle in spread_of.items()}
    if not solution.angular:
        centre = ends.mean(axis=1)
        column = np.median(centre[:, 0])
        depth = centre[:, 1] + (column - centre[:, 0]) * along[:, 1] / along[:, 0]
        # About the column at which the lines cross: turning the probe there does not change the depth.
        steps = np.column_stack([np.ones(len(slope)), np.tan(slope)])
        travel = depth - steps @ np.linalg.lstsq(steps, depth, rcond=None)[0]
        spread_of[UP_AND_DOWN] = float(travel.std() / steps_mm[1])
    return spread_of


def _independent_covariance(solution: Solution) -> FloatArray:
    """Covariance of `CHAIN` if errors are independent, as large as detection's, and answers plausible."""
    poses = np.tile(np.repeat([_UNKNOWN_MM, _UNKNOWN_RAD], 3), 2)
    before = np.minimum([*(solution.chain.pixel_mm * _UNKNOWN), *poses], solution.prior.sigma)
    sigma, columns = max(solution.sigma, _LEAST_SIGMA[int(solution.angular)]), columns_of(solution.free)
    information = solution.jacobian.T @ solution.jacobian / sigma**2 + np.diag(before[columns] ** -2.0)
    return in_chain(solution.free, np.linalg.inv(information))


def _errors(solution: Solution, covariance: FloatArray) -> FloatArray:
    """Standard errors of the worst corner, mm (zero for directions), and about the worst axis, rad."""
    angle = float(np.sqrt(np.linalg.eigvalsh(covariance[5:8, 5:8])[-1]))
    if solution.angular:
        return np.array([0.0, angle])
    slopes = solution.corner_slopes
    corners = np.einsum("kip,pq,kiq->k", slopes, covariance, slopes)
    return np.array([float(np.sqrt(corners.max())), angle])


def _size(error: float, angular: bool) -> str:
    value, unit = (np.rad2deg(error), "degrees") if angular else (error, "mm")
    return f"{value:.2g} {unit}" if value < 100 else f"{value:.0f} {unit}"
