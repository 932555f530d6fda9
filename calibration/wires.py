"""Calibration with wires: a crossing, three orthogonal wires, or N-shapes; solved as planes are.

References
----------
.. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, sections 3.1 and 3.2.
.. [2] P. R. Detmer et al., "3D ultrasonic image feature localization based on magnetic scanhead tracking",
   Ultrasound in Medicine and Biology, 1994 (the crossing).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import toeplitz
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.alternatives import best_solution
from calibration.chain import POSE, TARGET, Chain, ChainSolution, ImagePoints, SeenAs, residuals_and_jacobian
from calibration.consensus import GATES_MM, find_consensus, nearest_candidates
from calibration.identifiability import require_adequate
from calibration.near import near_jacobian
from calibration.solver import OUTLIER_SIGMA, SOME_FRAMES, probe_parameters, solve_chain
from calibration.starts import rotations_all_over, wire_start
from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.wires import WirePhantom

Registration = Literal["held", "turned", "free"]

_ESTIMATED: dict[str, tuple[str, ...]] = {"held": (), "turned": TARGET[3:], "free": TARGET}
BESIDE_MM = 0.1
"""A crossing is bright within tenths of a millimetre of the middle of the beam, where a hand keeps it."""

_FEWEST_FRAMES = 6
_STARTS = 6
_TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class CrossWire:
    """Two wires that cross, or a bead: one point, three equations (TR 303, equation 3)."""

    determined: tuple[str, ...] = TARGET[:3]
    seen_as: SeenAs = "dot"
    kept_in_plane: bool = True

    def vanishing(self, points: ImagePoints) -> tuple[FloatArray, FloatArray]:
        """Displacement from the crossing."""
        n = len(points)
        return np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))


@dataclass(frozen=True)
class Wires:
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
    kept_in_plane: bool = False

    def vanishing(self, points: ImagePoints) -> tuple[FloatArray, FloatArray]:
        """Displacement from the wire, along two directions across it."""
        if points.wire is None:
            raise InvalidInputError("expected points with the wire each lies on, got points without")
        return self.geometry.equations(points.wire)


def calibrate_cross_wire(
    points: ImagePoints,
    pixel_mm: FloatArray | None = None,
    fit_pixels: bool = True,
    outlier_sigma: float = OUTLIER_SIGMA,
    beside_mm: float = BESIDE_MM,
) -> ChainSolution:
    """Calibrate a 6-DOF sensor from images of two crossing wires, or of a bead.

    Parameters
    ----------
    points : ImagePoints
        The crossing in each frame, or several candidates for it, frames ascending and the likeliest first.
        Frames none of whose candidates agrees with the others are not used; they may be most.
    pixel_mm : ndarray, shape (2,), optional
        Column pitch and row spacing; needed unless they are fitted.
    fit_pixels : bool
        Eleven parameters, else nine.
    beside_mm : float
        Root mean square distance by which the hand misses the crossing, out of plane; claimed errors allow
        for it.

    Raises
    ------
    InsufficientDataError
        If there are too few points, no more of them agree than chance candidates would, or the motion does
        not determine the answer.
    """
    _require_frames(points)
    probe, held = probe_parameters(fit_pixels, pixel_mm)
    found = find_consensus(points, pixel_mm)
    if not found.believed and len(points) == len(points.frames):
        # Poor motion, too, can leave no consensus; then that is said.
        start, _ = wire_start(points, CrossWire().vanishing(points), Rotation.identity())
        require_adequate(best_solution(points, CrossWire(), [_sized(start, held)], probe, outlier_sigma))
    found.require()
    agreeing = points[found.nearest[found.agreed]]
    first = solve_chain(agreeing, CrossWire(), _sized(found.chain, held), probe, outlier_sigma)
    # The rigid chain, from all that agree, tells candidates better than the sample did.
    nearest, away = nearest_candidates(points, *_image_and_point(first.chain))
    near, chosen = away <= GATES_MM[-1], points[nearest]
    solution = best_solution(chosen[near], CrossWire(), [first.chain], probe, outlier_sigma)
    solution = _beside(solution, beside_mm)
    return require_adequate(_with_contradicting(solution, chosen, near))


def _beside(solution: ChainSolution, beside_mm: float) -> ChainSolution:
    """Allow for a hand that misses the point by `beside_mm`, at the pace at which it turns the probe.

    So slow an error the fit takes for tilt and yaw, and residuals tell nothing of it: its size is assumed,
    its autocorrelation is that of the motions that it is taken for.
    """
    points, phantom, chain, free = solution.points_used, solution.phantom, solution.chain, solution.free
    _, jacobian = near_jacobian(points, phantom, chain, free)
    out_of_plane = chain.target_from_image(points).rotation.as_matrix()[:, :, 2]
    pull = np.einsum("nip,ni->pn", jacobian.reshape(len(points), 3, -1), out_of_plane)
    moved = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True) @ pull
    posed = moved[[free.index(name) for name in POSE]]
    alike = sum(np.correlate(row, row, "full")[len(row) - 1 :] / max(row @ row, _TINY) for row in posed)
    covariance = beside_mm**2 * moved @ toeplitz(alike / max(alike[0], _TINY)) @ moved.T
    return replace(solution, noise=replace(solution.noise, covariance=solution.covariance + covariance))


def _image_and_point(chain: Chain) -> tuple[FloatArray, FloatArray]:
    """Origin and axes of the image in the sensor's frame, and the phantom's origin in the world."""
    pose = chain.sensor_from_image
    axes = pose.rotation.as_matrix().T[:2] * chain.pixel_mm[:, None]
    return np.vstack([pose.translation, axes]), np.asarray(chain.target_from_world.inv().translation)


def _with_contradicting(solution: ChainSolution, points: ImagePoints, held: BoolArray) -> ChainSolution:
    """The solution from `points[held]` with the residuals of the others, which are not used."""
    used = held.copy()
    used[held] = solution.used
    residuals, _ = residuals_and_jacobian(solution.chain.parameters(), points, solution.phantom)
    return replace(solution, points=points, used=used, residuals=residuals)


def calibrate_wires(
    points: ImagePoints,
    geometry: WirePhantom,
    pixel_mm: FloatArray | None = None,
    fit_pixels: bool = True,
    registration: Registration = "turned",
    outlier_sigma: float = OUTLIER_SIGMA,
) -> ChainSolution:
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
        and, over 50 mm, a turn only to a degree.

    Raises
    ------
    InsufficientDataError
        If there are too few points, they contradict each other, or the motion does not determine the answer.
    """
    if registration not in _ESTIMATED:
        raise InvalidInputError(
            f"registration: expected one of {', '.join(_ESTIMATED)}, got {registration!r}"
        )
    _require_frames(points)
    probe, held = probe_parameters(fit_pixels, pixel_mm)
    centred = _about_middle(geometry)
    place = centred.world_from_phantom
    if place is not None:
        phantom = Wires(centred, _ESTIMATED[registration])
        starts = [wire_start(points, phantom.vanishing(points), place.inv())[0]]
    else:
        phantom = Wires(centred)
        starts = _anywhere(points.of_some_frames(SOME_FRAMES), phantom)
    sized = [_sized(start, held) for start in starts]
    return require_adequate(best_solution(points, phantom, sized, probe, outlier_sigma))


def _about_middle(geometry: WirePhantom) -> WirePhantom:
    """The same wires in a frame whose origin is their middle, about which the phantom may be turned."""
    ends = geometry.points_mm if geometry.ends_mm is None else geometry.ends_mm.reshape(-1, 3)
    middle = ends.mean(axis=0)
    place = geometry.world_from_phantom
    moved = None if place is None else place * RigidTransform.from_translation(middle)
    shifted = None if geometry.ends_mm is None else geometry.ends_mm - middle
    return replace(geometry, points_mm=geometry.points_mm - middle, ends_mm=shifted, world_from_phantom=moved)


def _anywhere(few: ImagePoints, phantom: Wires) -> list[Chain]:
    """Best starts among orientations of the phantom spread over all rotations."""
    equations = phantom.vanishing(few)
    tried = [wire_start(few, equations, turn) for turn in rotations_all_over()]
    best = sorted(tried, key=lambda one: float(np.median(np.abs(one[1].residuals))))[:_STARTS]
    return [chain for chain, _ in best]


def _sized(start: Chain, pixel_mm: FloatArray | None) -> Chain:
    return start if pixel_mm is None else replace(start, pixel_mm=pixel_mm)


def _require_frames(points: ImagePoints) -> None:
    if len(points.frames) < _FEWEST_FRAMES:
        raise InsufficientDataError(
            f"expected the wires in at least {_FEWEST_FRAMES} frames, got {len(points.frames)}"
        )
