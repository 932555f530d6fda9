"""Calibration with wires: a crossing, three orthogonal wires, or N-shapes; solved as planes are.

References
----------
.. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, sections 3.1 and 3.2.
.. [2] P. R. Detmer et al., "3D ultrasonic image feature localization based on magnetic scanhead tracking",
   Ultrasound in Medicine and Biology, 1994 (the crossing).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import toeplitz
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.consensus import GATES_MM, find_consensus, nearest_candidates
from calibration.motion import require_adequate
from calibration.plane import Chain, Phantom
from calibration.points import POSE, SOME_FRAMES, TARGET, ImagePoints, SeenAs, affine_equations
from calibration.robust import robust_linear
from calibration.settings import Registration, WireFit
from calibration.solution import Problem, Solution, probe_parameters
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.geometry import nearest_rotation
from speckle3d.core.wires import WirePhantom

_ESTIMATED: dict[str, tuple[str, ...]] = {"held": (), "turned": TARGET[3:], "free": TARGET}

_FEWEST_FRAMES = 6
_STARTS = 6
_TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class CrossWire(Phantom):
    """Two wires that cross, or a bead: one point, three equations (TR 303, equation 3)."""

    determined: tuple[str, ...] = TARGET[:3]
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
    determined : tuple of str
        Parameters of the phantom's place in the tracker's world that are estimated; the others are held.
    """

    geometry: WirePhantom
    determined: tuple[str, ...] = TARGET
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
    s = settings or WireFit()
    _require_frames(points)
    probe, held = probe_parameters(s.fixed_pixels, pixel_mm)
    problem = Problem(CrossWire(), probe, s.outlier_sigma)
    found = find_consensus(points, pixel_mm)
    if not found.believed and len(points) == len(points.frames):
        # Poor motion, too, can leave no consensus; then that is said.
        start, _ = wire_start(points, CrossWire(), Rotation.identity())
        require_adequate(problem.best(points, [_sized(start, held)]))
    found.require()
    agreeing = points[found.nearest[found.agreed]]
    first = problem.solve(agreeing, _sized(squared(*found.affine), held))
    # The rigid chain, from all that agree, tells candidates better than the sample did.
    nearest, away = nearest_candidates(points, *_image_and_point(first.chain))
    near, chosen = away <= GATES_MM[-1], points[nearest]
    solution = _beside(problem.best(chosen[near], [first.chain]), s.beside_mm)
    used = near.copy()
    used[near] = solution.used
    residuals = CrossWire().equations(chosen).residuals(solution.chain)
    return require_adequate(replace(solution, points=chosen, used=used, residuals=residuals))


def _beside(solution: Solution, beside_mm: float) -> Solution:
    """Allow for a hand that misses the point by `beside_mm`, at the pace at which it turns the probe.

    So slow an error the fit takes for tilt and yaw, and residuals tell nothing of it: its size is assumed,
    its autocorrelation is that of the motions that it is taken for.
    """
    points, free, jacobian = solution.points_used, solution.free, solution.jacobian
    out_of_plane = solution.chain.target_from_image(points).rotation.as_matrix()[:, :, 2]
    pull = np.einsum("nip,ni->pn", jacobian.reshape(len(points), 3, -1), out_of_plane)
    moved = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True) @ pull
    posed = moved[[free.index(name) for name in POSE]]
    alike = sum(np.correlate(row, row, "full")[len(row) - 1 :] / max(row @ row, _TINY) for row in posed)
    covariance = beside_mm**2 * moved @ toeplitz(alike / max(alike[0], _TINY)) @ moved.T
    return replace(solution, covariance=solution.covariance + covariance)


def _image_and_point(chain: Chain) -> tuple[FloatArray, FloatArray]:
    """Origin and axes of the image in the sensor's frame, and the phantom's origin in the world."""
    pose = chain.sensor_from_image
    axes = pose.rotation.as_matrix().T[:2] * chain.pixel_mm[:, None]
    return np.vstack([pose.translation, axes]), np.asarray(chain.target_from_world.inv().translation)


def squared(image: FloatArray, point_mm: FloatArray) -> Chain:
    """The chain whose axes are square and nearest to an image's origin and axes, shape (3, 3)."""
    size = np.maximum(np.linalg.norm(image[1:], axis=1), 1e-6)
    turn = Rotation.from_matrix(nearest_rotation((image[1:] / size[:, None]).T))
    probe = RigidTransform.from_components(image[0], turn)
    return Chain.of(size, probe, RigidTransform.from_translation(-point_mm))


def calibrate_wires(
    points: ImagePoints,
    geometry: WirePhantom,
    pixel_mm: FloatArray | None = None,
    settings: WireFit | None = None,
    registration: Registration = "turned",
) -> Solution:
    """Calibrate a 6-DOF sensor from dots on straight wires.

    Parameters
    ----------
    points : ImagePoints
        With the wire each lies on.
    geometry : WirePhantom
        Without its place in the tracker's world, that is estimated, too: fourteen parameters in all, as for
        the three-wire phantom.
    registration : {"held", "turned", "free"}
        What to do with the place stated in `geometry`: hold it; hold the wires' middle and estimate how the
        phantom is turned about it; or estimate all. Stylus registrations find a place to half a millimetre,
        and, over 50 mm, a turn only to a degree. `registration.calibrate_registered` chooses.

    Raises
    ------
    InsufficientDataError
        If there are too few points, they contradict each other, or the motion does not determine the answer.
    """
    return require_adequate(solve_wires(points, geometry, pixel_mm, settings, registration))


def solve_wires(
    points: ImagePoints,
    geometry: WirePhantom,
    pixel_mm: FloatArray | None = None,
    settings: WireFit | None = None,
    registration: Registration = "turned",
) -> Solution:
    """As `calibrate_wires`, whether or not the motion determines the answer."""
    s = settings or WireFit()
    if registration not in _ESTIMATED:
        raise InvalidInputError(
            f"registration: expected one of {', '.join(_ESTIMATED)}, got {registration!r}"
        )
    _require_frames(points)
    probe, held = probe_parameters(s.fixed_pixels, pixel_mm)
    centred = _about_middle(geometry)
    place = centred.world_from_phantom
    if place is not None:
        phantom = Wires(centred, _ESTIMATED[registration])
        starts = [wire_start(points, phantom, place.inv())[0]]
    else:
        phantom = Wires(centred)
        few = points.of_some_frames(SOME_FRAMES)
        # Rotations of an icosahedron, 36 degrees apart.
        tried = [wire_start(few, phantom, turn) for turn in Rotation.create_group("I")]
        tried.sort(key=lambda one: one[1])
        starts = [chain for chain, _ in tried[:_STARTS]]
    return Problem(phantom, probe, s.outlier_sigma).best(points, [_sized(start, held) for start in starts])


def _about_middle(geometry: WirePhantom) -> WirePhantom:
    """The same wires in a frame whose origin is their middle, about which the phantom may be turned."""
    middle = geometry.points_mm.mean(axis=0)
    place = geometry.world_from_phantom
    moved = None if place is None else place * RigidTransform.from_translation(middle)
    return replace(geometry, ends_mm=geometry.ends_mm - middle, world_from_phantom=moved)


def _sized(start: Chain, pixel_mm: FloatArray | None) -> Chain:
    return start if pixel_mm is None else replace(start, pixel_mm=pixel_mm)


def _require_frames(points: ImagePoints) -> None:
    if len(points.frames) < _FEWEST_FRAMES:
        raise InsufficientDataError(
            f"expected the wires in at least {_FEWEST_FRAMES} frames, got {len(points.frames)}"
        )


def wire_start(
    points: ImagePoints, phantom: Phantom, target_from_world: RigidTransform | Rotation
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
    rows, offsets = phantom.vanishing(points)
    shifted = isinstance(target_from_world, Rotation)
    known = (
        RigidTransform.from_rotation(target_from_world)
        if isinstance(target_from_world, Rotation)
        else target_from_world
    )
    # Pixels are centred and scaled, for a well-conditioned matrix.
    centre, spread = points.pixels.mean(axis=0), float(points.pixels.std()) or 1.0
    matrix = affine_equations(
        (points.pixels - centre) / spread, rows @ known.rotation.as_matrix() @ points.turns
    )
    if shifted:
        matrix = np.concatenate([matrix, rows], axis=2)
    wanted = offsets - np.einsum("nri,ni->nr", rows, known.apply(points.shifts_mm))
    found, left = robust_linear(matrix, wanted)
    axes = found[3:9].reshape(2, 3) / spread
    image = np.vstack([found[:3] - centre @ axes, axes])
    shift = RigidTransform.from_translation(found[9:] if shifted else np.zeros(3))
    chain = squared(image, np.zeros(3))
    return replace(chain, target=(shift * known).as_matrix()), float(np.median(np.abs(left)))
