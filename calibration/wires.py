"""Calibration with wires: a crossing, three orthogonal wires, or N-shapes; solved as planes are.

A place that is stated of a phantom counts as known to what a stylus achieves: where the motion tells little
it holds the answer, and dots that contradict it by more are believed instead.

References
----------
.. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, sections 3.1 and 3.2.
.. [2] P. R. Detmer et al., "3D ultrasonic image feature localization based on magnetic scanhead tracking",
   Ultrasound in Medicine and Biology, 1994 (the crossing).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import toeplitz
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.consensus import GATES_MM, choose_by_frame, find_consensus
from calibration.motion import require_adequate
from calibration.plane import Chain, Equations, Phantom
from calibration.points import POSE, SOME_FRAMES, TARGET, ImagePoints, affine_equations
from calibration.robust import robust_linear
from calibration.settings import WireFit
from calibration.solution import Problem, Solution
from speckle3d.core.arrays import FloatArray
from speckle3d.core.geometry import nearest_rotation
from speckle3d.core.wires import WirePhantom

_REGISTRATIONS = {"held": (), "turned": TARGET[3:], "free": TARGET, "auto": TARGET}
"""What is estimated of a stated place."""
_STARTS = 6
_TINY, _LEAST_PIXEL_MM = np.finfo(float).tiny, 1e-6
_OUTWARD = 0.005
"""Share by which crossings are placed too far from the middle of the columns, beyond whose sides filters see
nothing: 0.46 % (standard error 0.11) in 80 simulated scans of two threads. Of 40 other scans, 70 and 95 % of
the errors of s_x then lie within 68 and 95 % intervals (without it 68 and 92)."""
_AS_IT_IS = Rotation.identity()
"""A point has no orientation."""


CROSSING = Phantom(TARGET[:3], "dot", ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
"""Two wires that cross, or a bead: one point, three equations (TR 303, equation 3)."""


@dataclass(frozen=True)
class Wires(Phantom):
    """Straight wires of known geometry: two equations for each dot (TR 303, equation 7).

    Parameters
    ----------
    geometry : WirePhantom
    """

    geometry: WirePhantom = field(kw_only=True)

    def equations(self, points: ImagePoints) -> Equations:
        """Displacements from the wires, along two directions across each."""
        return Equations(points, *self.geometry.equations(points.wires))


def calibrate_cross_wire(
    points: ImagePoints, pixel_mm: FloatArray, settings: WireFit | None = None
) -> Solution:
    """Calibrate a 6-DOF sensor from images of two crossing wires, or of a bead.

    Parameters
    ----------
    points : ImagePoints
        The crossing in each frame, or several candidates for it, frames ascending and the likeliest first.
        Frames none of whose candidates agrees with the others are not used; they may be most.
    pixel_mm : ndarray, shape (2,)
        Column pitch and row spacing, to a factor of two unless they are fixed.

    Raises
    ------
    InsufficientDataError
        If there are too few points, no more of them agree than chance candidates would, or the motion does
        not determine the answer.
    """
    s, phantom = settings or WireFit(), CROSSING
    problem = Problem.of(phantom, pixel_mm, s)
    consensus = find_consensus(points, pixel_mm)
    if not consensus.is_significant and len(points) == len(points.frames):
        # Poor motion, too, can leave no consensus; then that is said.
        require_adequate(problem.best(points, [wire_start(points, problem, _AS_IT_IS)[0]]), pixel_mm)
    consensus.require()
    agreeing = points[consensus.choice[consensus.inliers]]
    first = problem.solve(agreeing, wire_start(agreeing, problem, _AS_IT_IS)[0])
    # The rigid chain, from all that agree, tells candidates better than the sample did.
    away_mm = np.linalg.norm(phantom.equations(points).residuals(first.chain), axis=1)
    choice = choose_by_frame(points.frame, away_mm)
    inliers, crossings = away_mm[choice] <= GATES_MM[-1], points[choice]
    solution = _beside(problem.best(crossings[inliers], [first.chain]), s.beside_mm)
    inliers[inliers] = solution.used
    residuals = phantom.equations(crossings).residuals(solution.chain)
    solution = replace(solution, points=crossings, used=inliers, residuals=residuals)
    return require_adequate(solution, pixel_mm)


def _beside(solution: Solution, beside_mm: float) -> Solution:
    """Allow for a hand that misses the point by `beside_mm`, at the pace at which it turns the probe.

    So slow an error the fit takes for tilt and yaw, and residuals tell nothing of it: its size is assumed,
    its autocorrelation is that of the motions that it is taken for. Places that lean outwards are taken for
    wider pixels.
    """
    points, free, jacobian = solution.points_used, solution.free, solution.jacobian
    out_of_plane = solution.chain.target_from_image(points).rotation.as_matrix()[:, :, 2]
    pull = np.einsum("nip,ni->pn", jacobian.reshape(len(points), 3, -1), out_of_plane)
    motion = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True) @ pull
    of_pose = motion[[free.index(name) for name in POSE]]
    correlation = sum(np.correlate(p, p, "full")[len(p) - 1 :] / max(p @ p, _TINY) for p in of_pose)
    covariance = beside_mm**2 * motion @ toeplitz(correlation / max(correlation[0], _TINY)) @ motion.T
    outward = _OUTWARD * solution.chain.pixel_mm[0] * (np.array(free) == "s_x")
    covariance += np.outer(outward, outward)
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
        estimate how the phantom is turned about it; or estimate all. By default all is estimated, and the
        place counts as known to 0.5 mm and a degree, unless the dots move it by three times as much; the
        solution says by how much they do.

    Raises
    ------
    InsufficientDataError
        If there are too few points, they contradict each other, or the motion does not determine the answer.
    """
    return require_adequate(solve_wires(points, geometry, pixel_mm, settings), pixel_mm)


def solve_wires(
    points: ImagePoints,
    geometry: WirePhantom,
    pixel_mm: FloatArray | None = None,
    settings: WireFit | None = None,
) -> Solution:
    """As `calibrate_wires`, whether or not the motion determines the answer."""
    s, middle, place = settings or WireFit(), geometry.points_mm.mean(axis=0), geometry.world_from_phantom
    if place is not None:
        place = place * RigidTransform.from_translation(middle)
    # In a frame whose origin is the wires' middle, about which the phantom may be turned.
    about_middle = replace(geometry, ends_mm=geometry.ends_mm - middle, world_from_phantom=place)
    unknowns = TARGET if place is None else _REGISTRATIONS[s.registration]
    phantom = Wires(unknowns, "dot", geometry=about_middle)
    problem = Problem.of(phantom, pixel_mm, s)
    few = points.of_some_frames(SOME_FRAMES)
    # Without a place, the rotations of an icosahedron, 36 degrees apart.
    poses = Rotation.create_group("I") if place is None else [place.inv()]
    starts = [wire_start(few, problem, pose) for pose in poses]
    starts.sort(key=lambda start: start[1])
    chains = [chain for chain, _ in starts[:_STARTS]]
    if place is None or s.registration != "auto":
        return problem.best(points, chains)
    prior = problem.prior.with_place(place.as_matrix())
    solution = replace(problem, prior=prior).best(points, chains)
    use = "counts as known to 0.5 mm and 1 degree"
    if solution.contradicts_prior:
        solution, use = problem.best(points, [solution.chain]), "does not count"
    offset = prior.displacement(solution.chain)
    shift_mm, turn_deg = np.linalg.norm(offset[8:11]), np.rad2deg(np.linalg.norm(offset[11:]))
    assumption = (
        f"the phantom's stated place {use}; the dots put it {shift_mm:.2f} mm and {turn_deg:.1f} degrees off"
    )
    return replace(solution, assumed=assumption)


def wire_start(
    points: ImagePoints, problem: Problem, target_from_world: RigidTransform | Rotation
) -> tuple[Chain, float]:
    """Find the image among wires from all frames of a recording, by robust linear least squares.

    The axes come out free of the constraint that they be square; the chain has the nearest that are.

    Parameters
    ----------
    target_from_world : RigidTransform or Rotation
        If a rotation, the translation is found too.

    Returns
    -------
    chain : Chain
    median_mm : float
        Of the residuals' magnitudes, before the axes are squared.
    """
    equations = problem.phantom.equations(points)
    rows, offsets, target = equations.rows, equations.offsets, np.eye(4)
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
    known_mm = problem.prior.known_pixel_mm
    return Chain(size if known_mm is None else known_mm, probe, target), float(np.median(np.abs(left)))
