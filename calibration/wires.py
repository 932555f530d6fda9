"""Calibration with wires: a crossing, three orthogonal wires, or N-shapes; solved by the plane module.

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
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.chain import PROBE, SCALES, TARGET, Chain, ImagePoints, Phantom, Seen
from calibration.identifiability import require_adequate
from calibration.plane import OUTLIER_SIGMA, solve, some
from calibration.solution import Solution
from calibration.starts import least_absolute, rotations_all_over
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.geometry import nearest_rotation
from speckle3d.core.wires import WirePhantom

Registration = Literal["held", "turned", "free"]

_ESTIMATED: dict[str, tuple[str, ...]] = {"held": (), "turned": TARGET[3:], "free": TARGET}
_FEWEST_FRAMES = 6
_STARTS = 6


@dataclass(frozen=True)
class Crossing:
    """Two wires that cross, or a bead: one point, three equations (TR 303, equation 3)."""

    determined: tuple[str, ...] = TARGET[:3]
    seen_as: Seen = "dot"

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
        What of the phantom's place in the tracker's world is estimated; the rest is held.
    """

    geometry: WirePhantom
    determined: tuple[str, ...] = TARGET
    seen_as: Seen = "dot"

    def vanishing(self, points: ImagePoints) -> tuple[FloatArray, FloatArray]:
        """Displacement from the wire, along two directions across it."""
        if points.wire is None:
            raise InvalidInputError("expected points with the wire each lies on, got points without")
        rows = self.geometry.normals[points.wire]
        return rows, np.einsum("nri,ni->nr", rows, self.geometry.points_mm[points.wire])


def calibrate_crossing(
    points: ImagePoints,
    pixel_mm: FloatArray | None = None,
    fit_pixels: bool = True,
    outlier_sigma: float = OUTLIER_SIGMA,
) -> Solution:
    """Calibrate a 6-DOF sensor from images of two crossing wires, or of a bead.

    Parameters
    ----------
    points : ImagePoints
        The crossing in each frame.
    pixel_mm : ndarray, shape (2,), optional
        Column pitch and row spacing; needed unless they are fitted.
    fit_pixels : bool
        Eleven parameters, else nine.

    Raises
    ------
    InsufficientDataError
        If there are too few points, they contradict each other, or the motion does not determine the answer.
    """
    start = _linear_start(points, Crossing(), Rotation.identity(), fitted=True)[0]
    return _finished(points, Crossing(), start, pixel_mm, fit_pixels, outlier_sigma)


def calibrate_wires(
    points: ImagePoints,
    geometry: WirePhantom,
    pixel_mm: FloatArray | None = None,
    fit_pixels: bool = True,
    registration: Registration = "turned",
    outlier_sigma: float = OUTLIER_SIGMA,
) -> Solution:
    """Calibrate a 6-DOF sensor from dots on straight wires.

    Parameters
    ----------
    points : ImagePoints
        With the wire each lies on.
    geometry : WirePhantom
        Where it does not say where it is in the tracker's world, that is estimated, too: fourteen parameters
        in all, as for the three-wire phantom.
    registration : {"held", "turned", "free"}
        What to do with a place that `geometry` says: hold it; hold the wires' middle and estimate how the
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
    centred = _about_middle(geometry)
    place = centred.world_from_phantom
    if place is not None:
        phantom = Wires(centred, _ESTIMATED[registration])
        start = _linear_start(points, phantom, place.inv(), fitted=False)[0]
    else:
        phantom = Wires(centred)
        start = _anywhere(some(points), phantom, pixel_mm, fit_pixels)
    return _finished(points, phantom, start, pixel_mm, fit_pixels, outlier_sigma)


def _about_middle(geometry: WirePhantom) -> WirePhantom:
    """The same wires in a frame whose origin is the middle of them, about which the phantom may be turned."""
    ends = geometry.points_mm if geometry.ends_mm is None else geometry.ends_mm.reshape(-1, 3)
    middle = ends.mean(axis=0)
    place = geometry.world_from_phantom
    moved = None if place is None else place * RigidTransform.from_translation(middle)
    shifted = None if geometry.ends_mm is None else geometry.ends_mm - middle
    return replace(geometry, points_mm=geometry.points_mm - middle, ends_mm=shifted, world_from_phantom=moved)


def _anywhere(few: ImagePoints, phantom: Wires, pixel_mm: FloatArray | None, fit_pixels: bool) -> Chain:
    """Best start with the phantom turned every way there is."""
    tried = [_linear_start(few, phantom, turn, fitted=True) for turn in rotations_all_over()]
    best = sorted(tried, key=lambda one: one[1])[:_STARTS]
    probe = PROBE if fit_pixels else PROBE[len(SCALES) :]
    settled = [solve(few, phantom, _sized(chain, pixel_mm, fit_pixels), probe, np.inf) for chain, _ in best]
    return min(settled, key=lambda solution: solution.sigma).chain


def _finished(
    points: ImagePoints,
    phantom: Phantom,
    start: Chain,
    pixel_mm: FloatArray | None,
    fit_pixels: bool,
    outlier_sigma: float,
) -> Solution:
    frames = len(np.unique(points.frame))
    if frames < _FEWEST_FRAMES:
        raise InsufficientDataError(f"expected the wires in at least {_FEWEST_FRAMES} frames, got {frames}")
    probe = PROBE if fit_pixels else PROBE[len(SCALES) :]
    return require_adequate(solve(points, phantom, _sized(start, pixel_mm, fit_pixels), probe, outlier_sigma))


def _sized(start: Chain, pixel_mm: FloatArray | None, fit_pixels: bool) -> Chain:
    if fit_pixels:
        return start
    if pixel_mm is None:
        raise InvalidInputError(
            "expected pixel_mm, the scanner's pixel size, where it is not fitted, got none"
        )
    return Chain(np.asarray(pixel_mm, dtype=float), start.sensor_from_image, start.target_from_world)


def _linear_start(
    points: ImagePoints, phantom: Phantom, place: Rotation | RigidTransform, fitted: bool
) -> tuple[Chain, float]:
    """Chain whose image axes need not be square, by linear least absolute values, then squared.

    Parameters
    ----------
    place : Rotation or RigidTransform
        ``target_from_world``; of a rotation the translation is found too.

    Returns
    -------
    chain : Chain
    cost : float
        Median absolute residual before squaring, mm.
    """
    known = place if isinstance(place, RigidTransform) else RigidTransform.from_rotation(place)
    rows, offsets = phantom.vanishing(points)
    in_world = rows @ known.rotation.as_matrix()
    in_sensor = in_world @ points.turns
    pixels = np.column_stack([points.pixels, np.ones(len(points))])
    matrix = np.einsum("nri,na->nrai", in_sensor, pixels).reshape(-1, 9)
    if fitted:
        matrix = np.concatenate([matrix, rows.reshape(-1, 3)], axis=1)
    at_sensor = known.apply(points.shifts_mm)
    wanted = (offsets - np.einsum("nri,ni->nr", rows, at_sensor)).ravel()
    found, misfit = least_absolute(matrix, wanted)
    columns, rows_axis, origin = found[:9].reshape(3, 3)
    size = np.array([np.linalg.norm(columns), np.linalg.norm(rows_axis)])
    turn = nearest_rotation(np.column_stack([columns, rows_axis]) / size)
    probe = RigidTransform.from_components(origin, Rotation.from_matrix(turn))
    shift = RigidTransform.from_translation(found[9:12]) if fitted else RigidTransform.identity()
    return Chain(size, probe, shift * known), float(np.median(np.abs(misfit)))
