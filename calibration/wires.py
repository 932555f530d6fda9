"""Calibration with wires: a crossing, three orthogonal wires, or N-shapes; solved as planes are.

A place that is stated of a phantom is best held if it is good, for what is not estimated cannot be wrong; if
wrong it spoils the calibration. Frames that were left out tell: a calibration that explains them better is
nearer the truth, and one that follows the errors of its own frames is not.

References
----------
.. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, sections 3.1 and 3.2.
.. [2] P. R. Detmer et al., "3D ultrasonic image feature localization based on magnetic scanhead tracking",
   Ultrasound in Medicine and Biology, 1994 (the crossing).
.. [3] P. Burman, E. Chow and D. Nolan, "A cross-validatory method for dependent data", Biometrika 81, 1994
   (blocks in time).
.. [4] L. Breiman, J. Friedman, C. J. Stone and R. A. Olshen, "Classification and regression trees", 1984,
   section 3.4.3 (the simplest within one standard error of the best).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import toeplitz
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.consensus import GATES_MM, find_consensus, nearest_of_frames
from calibration.motion import require_adequate
from calibration.plane import Chain, Phantom
from calibration.points import POSE, SOME_FRAMES, TARGET, ImagePoints, SeenAs, affine_equations
from calibration.robust import robust_linear
from calibration.settings import WireFit
from calibration.solution import Problem, Solution
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.geometry import nearest_rotation
from speckle3d.core.wires import WirePhantom

_REGISTRATIONS: dict[str, tuple[tuple[str, ...], str]] = {
    "held": ((), "held"),
    "turned": (TARGET[3:], "held at the wires' middle and turned about it"),
    "free": (TARGET, "estimated anew"),
}
"""What is estimated of a stated place, simplest first, and its words in messages."""
_FOLDS = 8
"""Blocks of successive frames, each left out once: a tracker's error wanders over seconds, and frames beside
each other would vouch for each other."""
_STARTS = 6
_TINY, _LEAST_PIXEL_MM = np.finfo(float).tiny, 1e-6
_AS_IT_IS = Rotation.identity()
"""A point has no orientation."""


@dataclass(frozen=True)
class CrossWire(Phantom):
    """Two wires that cross, or a bead: one point, three equations (TR 303, equation 3)."""

    unknowns: tuple[str, ...] = TARGET[:3]
    seen_as: SeenAs = "dot"

    def vanishing(self, points: ImagePoints) -> tuple[FloatArray, FloatArray]:
        """Displacement from the crossing."""
        n = len(points)
        return np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))


@dataclass(frozen=True)
class Wires(Phantom):
    """Straight wires of known geometry: two equations for each dot (TR 303, equation 7).

    Parameters
    ----------
    geometry : WirePhantom
    unknowns : tuple of str
        Parameters of the phantom's place in the tracker's world that are estimated; the others are held.
    """

    geometry: WirePhantom
    unknowns: tuple[str, ...] = TARGET
    seen_as: SeenAs = "dot"

    def vanishing(self, points: ImagePoints) -> tuple[FloatArray, FloatArray]:
        """Displacement from the wire, along two directions across it."""
        if points.wire is None:
            raise InvalidInputError("expected points with the wire each lies on, got points without")
        return self.geometry.equations(points.wire)


def calibrate_cross_wire(
    points: ImagePoints, pixel_mm: FloatArray | None = None, settings: WireFit | None = None
) -> Solution:
    """Calibrate a 6-DOF sensor from images of two crossing wires, or of a bead.

    Parameters
    ----------
    points : ImagePoints
        The crossing in each frame, or several candidates for it, frames ascending and the likeliest first.
        Frames none of whose candidates agrees with the others are not used; they may be most.
    pixel_mm : ndarray, shape (2,), optional
        Column pitch and row spacing; needed if they are fixed.

    Raises
    ------
    InsufficientDataError
        If there are too few points, no more of them agree than chance candidates would, or the motion does
        not determine the answer.
    """
    s, phantom = settings or WireFit(), CrossWire()
    problem = Problem.of(phantom, pixel_mm, s)
    consensus = find_consensus(points, pixel_mm)
    if not consensus.is_significant and len(points) == len(points.frames):
        # Poor motion, too, can leave no consensus; then that is said.
        require_adequate(problem.best(points, [wire_start(points, phantom, _AS_IT_IS, problem.held_mm)[0]]))
    consensus.require()
    agreeing = points[consensus.nearest[consensus.inliers]]
    first = problem.solve(agreeing, wire_start(agreeing, phantom, _AS_IT_IS, problem.held_mm)[0])
    # The rigid chain, from all that agree, tells candidates better than the sample did.
    away_mm = np.linalg.norm(phantom.equations(points).residuals(first.chain), axis=1)
    nearest = nearest_of_frames(points.frame, away_mm)
    inliers, crossings = away_mm[nearest] <= GATES_MM[-1], points[nearest]
    solution = _beside(problem.best(crossings[inliers], [first.chain]), s.beside_mm)
    inliers[inliers] = solution.used
    residuals = phantom.equations(crossings).residuals(solution.chain)
    return require_adequate(replace(solution, points=crossings, used=inliers, residuals=residuals))


def _beside(solution: Solution, beside_mm: float) -> Solution:
    """Allow for a hand that misses the point by `beside_mm`, at the pace at which it turns the probe.

    So slow an error the fit takes for tilt and yaw, and residuals tell nothing of it: its size is assumed,
    its autocorrelation is that of the motions that it is taken for.
    """
    points, free, jacobian = solution.points_used, solution.free, solution.jacobian
    out_of_plane = solution.chain.target_from_image(points).rotation.as_matrix()[:, :, 2]
    pull = np.einsum("nip,ni->pn", jacobian.reshape(len(points), 3, -1), out_of_plane)
    motion = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True) @ pull
    of_pose = motion[[free.index(name) for name in POSE]]
    correlation = sum(np.correlate(p, p, "full")[len(p) - 1 :] / max(p @ p, _TINY) for p in of_pose)
    covariance = beside_mm**2 * motion @ toeplitz(correlation / max(correlation[0], _TINY)) @ motion.T
    return replace(solution, covariance=solution.covariance + covariance)


def calibrate_wires(
    points: ImagePoints,
    geometry: WirePhantom,
    pixel_mm: FloatArray | None = None,
    settings: WireFit | None = None,
) -> Solution:
    """Calibrate a 6-DOF sensor from dots on straight wires.

    Parameters
    ----------
    points : ImagePoints
        With the wire each lies on.
    geometry : WirePhantom
        Without its place in the tracker's world, that is estimated, too: fourteen parameters in all, as for
        the three-wire phantom.
    settings : WireFit, optional
        `registration` says what to do with a place that is stated: hold it; hold the wires' middle and
        estimate how the phantom is turned about it; or estimate all. Stylus registrations find a place to
        half a millimetre, and, over 50 mm, a turn only to a degree. By default the simplest counts that
        explains frames left out as well as any; the solution says which.

    Raises
    ------
    InsufficientDataError
        If there are too few points, they contradict each other, or the motion does not determine the answer.
    """
    s = settings or WireFit()
    if geometry.world_from_phantom is None or s.registration != "auto":
        return require_adequate(solve_wires(points, geometry, pixel_mm, s))
    solutions, misses_mm = dict[str, Solution](), dict[str, FloatArray]()
    for name in _REGISTRATIONS:
        registration = s.model_copy(update={"registration": name})
        try:
            solutions[name] = require_adequate(solve_wires(points, geometry, pixel_mm, registration))
            misses_mm[name] = _cross_validate(solutions[name])
        except InsufficientDataError:
            if name == "free" and not solutions:
                raise
    least_mm = min(misses_mm.values(), key=lambda miss: float(miss.mean()))
    excess_mm = {name: miss - least_mm for name, miss in misses_mm.items()}
    simplest = next(n for n, e in excess_mm.items() if e.mean() <= np.std(e, ddof=1) / np.sqrt(len(e)))
    sizes = ", ".join(f"{miss.mean():.3f} mm if {name}" for name, miss in misses_mm.items())
    choice = f"the phantom's stated place is {_REGISTRATIONS[simplest][1]}: left-out frames miss their wires"
    return replace(solutions[simplest], assumed=f"{choice} by {sizes}")


def _cross_validate(solution: Solution) -> FloatArray:
    """Mean distance from the wires, mm, of the dots of each block of frames, by a fit to the other blocks."""
    equations, misses_mm = solution.phantom.equations(solution.points), []
    for frames in np.array_split(solution.points.frames, _FOLDS):
        test = np.isin(solution.points.frame, frames)
        chain = equations[solution.used & ~test].least_squares(solution.chain, solution.free)
        misses_mm.append(float(np.linalg.norm(equations[test].residuals(chain), axis=1).mean()))
    return np.array(misses_mm)


def solve_wires(
    points: ImagePoints,
    geometry: WirePhantom,
    pixel_mm: FloatArray | None = None,
    settings: WireFit | None = None,
) -> Solution:
    """As `calibrate_wires`, whether or not the motion determines the answer; ``auto`` is ``turned``."""
    s, middle, place = settings or WireFit(), geometry.points_mm.mean(axis=0), geometry.world_from_phantom
    registration = "turned" if s.registration == "auto" else s.registration
    if place is not None:
        place = place * RigidTransform.from_translation(middle)
    # In a frame whose origin is the wires' middle, about which the phantom may be turned.
    about_middle = replace(geometry, ends_mm=geometry.ends_mm - middle, world_from_phantom=place)
    phantom = Wires(about_middle, TARGET if place is None else _REGISTRATIONS[registration][0])
    problem = Problem.of(phantom, pixel_mm, s)
    few = points.of_some_frames(SOME_FRAMES)
    # Without a place, the rotations of an icosahedron, 36 degrees apart.
    poses = Rotation.create_group("I") if place is None else [place.inv()]
    starts = [wire_start(few, phantom, pose, problem.held_mm) for pose in poses]
    starts.sort(key=lambda start: start[1])
    return problem.best(points, [chain for chain, _ in starts[:_STARTS]])


def wire_start(
    points: ImagePoints,
    phantom: Phantom,
    target_from_world: RigidTransform | Rotation,
    pixel_mm: FloatArray | None = None,
) -> tuple[Chain, float]:
    """Find the image among wires from all frames of a recording, by robust linear least squares.

    The axes come out free of the constraint that they be square; the chain has the nearest that are.

    Parameters
    ----------
    target_from_world : RigidTransform or Rotation
        If a rotation, the translation is found too.
    pixel_mm : ndarray, shape (2,), optional
        In place of the axes' lengths.

    Returns
    -------
    chain : Chain
    median_mm : float
        Of the residuals' magnitudes, before the axes are squared.
    """
    rows, offsets = phantom.vanishing(points)
    target = np.eye(4)
    if isinstance(target_from_world, Rotation):
        target[:3, :3] = target_from_world.as_matrix()
    else:
        target = target_from_world.as_matrix()
    # Pixels are centred and scaled, for a well-conditioned matrix.
    centre, spread = points.pixels.mean(axis=0), float(points.pixels.std()) or 1.0
    matrix = affine_equations((points.pixels - centre) / spread, rows @ target[:3, :3] @ points.turns)
    if isinstance(target_from_world, Rotation):
        matrix = np.concatenate([matrix, rows], axis=2)
    in_target = points.shifts_mm @ target[:3, :3].T + target[:3, 3]
    answer, left = robust_linear(matrix, offsets - np.einsum("nri,ni->nr", rows, in_target))
    axes, probe = answer[3:9].reshape(2, 3) / spread, np.eye(4)
    size = np.maximum(np.linalg.norm(axes, axis=1), _LEAST_PIXEL_MM)
    probe[:3, :3], probe[:3, 3] = nearest_rotation((axes / size[:, None]).T), answer[:3] - centre @ axes
    target[:3, 3] += answer[9:] if len(answer) > 9 else 0.0
    chain = Chain(size if pixel_mm is None else pixel_mm, probe, target)
    return chain, float(np.median(np.abs(left)))
