"""Assignment of dots to the wires of an N-wire phantom.

Each frame is first treated by itself: three dots in a line may be the wires of a layer, parallel lines at the
right distances may be the layers, and the hypothesis counts whose dots best fit a pose of the image among the
wires. A calibration from the frames that show all wires then predicts where each wire is seen in the others,
and a dot found there counts even if dots of other wires are missing.

References
----------
.. [1] T. K. Chen, A. D. Thurston, R. E. Ellis and P. Abolmaesumi, "A real-time freehand ultrasound
   calibration system with automatic accuracy feedback and control", Ultrasound Med. Biol. 35, 2009.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import RigidTransform

from calibration.plane import Chain
from calibration.points import Detections, affine_equations
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.wires import WirePhantom

_STEEPEST = 2.0
"""Largest ratio of a distance in the image to that in the phantom: of an image 60 degrees from square."""
_PARALLEL_COSINE = 0.99
_MOST_HYPOTHESES = 4000
_LIKE_MM = 0.1
"""Of hypotheses whose misfit is within this of the best, the one with the strongest dots counts."""
_LEAST_MM = 0.5
"""A middle dot nearer to an outer one than this is the same dot: dots are found at least so far apart."""
_COLLINEAR_MM = 0.8
"""How far a dot may be off the line of the outer two."""
_RESIDUAL_MM = 0.5
"""Largest root mean square misfit of a frame's dots."""
_RIDGE_MM2 = 1e-3
"""Holds axes that the wires leave open near zero; a dot 10 mm off the centre weighs 100 mm^2."""
_GATE_MM = 1.5
"""How far from where a calibration says it is a wire's dot may be."""
_TINY = 1e-12
_WIDTHS, _GAPS = (0.9, 1.1 * _STEEPEST), (0.85, 1.1 * _STEEPEST)
"""Distances in the image over the phantom's: of a layer's outer wires, and between layers."""


def label_dots(dots: Detections, phantom: WirePhantom, pixel_mm: FloatArray) -> Detections:
    """Assign dots to the wires of an N-wire phantom, each frame by itself.

    Parameters
    ----------
    pixel_mm : ndarray, shape (2,)
        Distance between columns and between rows, mm, known to 5 %.

    Returns
    -------
    Detections
        All wires of all N in each frame, or none. Where a phantom's symmetry leaves a choice, its first
        pattern is taken to be uppermost and its first wire on the side of the last column.

    Raises
    ------
    InvalidInputError
        If the phantom has fewer than two N.
    """
    layers, score = _layers(phantom), dots.score
    assert score is not None
    wires = np.concatenate([layer.wires for layer in layers])
    pixels: dict[int, FloatArray] = {}
    reasons = dict(dots.dropped)
    for frame in np.unique(dots.frame):
        in_frame = dots.frame == frame
        dots_mm, strength = dots.pixels[in_frame] * pixel_mm, score[in_frame]
        try:
            triples = [_triples(dots_mm, layer, phantom) for layer in layers]
            hypotheses = _combine(triples, dots_mm, strength, layers)
            rms_mm = misfits_mm(dots_mm[hypotheses], wires, phantom)
            best = float(rms_mm.min())
            if best > _RESIDUAL_MM:
                raise InsufficientDataError(
                    f"no dots fit the wires: the nearest miss by {best:.2f} mm RMS, {_RESIDUAL_MM} allowed"
                )
            hypotheses = hypotheses[rms_mm <= best + _LIKE_MM]
            # Rounded, so that where the same dots fit either way round, the usual one counts: the first
            # wire on the side of the last columns, the first layer uppermost.
            total = np.round(strength[hypotheses].sum(axis=1) / strength.max(), 6)
            first, last = (dots_mm[hypotheses].reshape(len(hypotheses), -1, 3, 2)[:, k] for k in (0, -1))
            usual = (first[:, 0, 0] >= first[:, 2, 0]) * 1
            usual += first[..., 1].mean(axis=1) <= last[..., 1].mean(axis=1)
            pixels[int(frame)] = dots.pixels[in_frame][hypotheses[np.lexsort((usual, total))[-1]]]
        except InsufficientDataError as error:
            reasons[int(frame)] = f"{error} ({len(dots_mm)} dots for {wires.size} wires)"
    return Detections(
        frame=np.repeat(np.array(list(pixels), dtype=np.int64), wires.size),
        pixels=np.concatenate([np.zeros((0, 2)), *pixels.values()]),
        wire=np.tile(wires, len(pixels)),
        dropped=reasons,
    )


def label_by_calibration(
    dots: Detections,
    phantom: WirePhantom,
    chain: Chain,
    world_from_sensor: RigidTransform,
) -> Detections:
    """Assign to each wire the dot nearest to where a calibration predicts it.

    Parameters
    ----------
    chain : Chain
        The calibration, and where the phantom is.
    world_from_sensor : RigidTransform
        One for each frame of the sequence.

    Returns
    -------
    Detections
        The wires found in each frame.
    """
    image_from_phantom = (chain.target_from_world * world_from_sensor * chain.sensor_from_image).inv()
    labels: list[tuple[int, int, int]] = []
    reasons, score = dict(dots.dropped), dots.score
    assert score is not None
    for frame in np.unique(dots.frame):
        in_frame, pose = np.flatnonzero(dots.frame == frame), image_from_phantom[int(frame)]
        place, along = pose.apply(phantom.points_mm), pose.rotation.apply(phantom.directions)
        # Where the image cuts each wire: far away, where it hardly does.
        steps = -place[:, 2] / np.where(along[:, 2] == 0, _TINY, along[:, 2])
        expected_mm = (place + steps[:, None] * along)[:, :2]
        # Each dot of one wire at most; a stronger dot may be farther away.
        dots_mm = dots.pixels[in_frame] * chain.pixel_mm
        share = np.linalg.norm(dots_mm[:, None] - expected_mm, axis=2) / _GATE_MM
        worth = np.where(share < 1.0, score[in_frame, None] * np.exp(-2.0 * share**2), 0.0)
        dot, wire = linear_sum_assignment(worth, maximize=True)
        near = sorted((int(w), int(in_frame[d])) for d, w in zip(dot, wire, strict=True) if worth[d, w] > 0)
        labels += [(int(frame), number, w) for w, number in near]
        if not near:
            reasons[int(frame)] = "no dot where the calibration expects a wire"
    frames, index, wires = np.array(labels, dtype=np.int64).reshape(-1, 3).T
    return Detections(frames, dots.pixels[index], wires, reasons)


@dataclass(frozen=True)
class _WireLayer:
    """A layer of wires, an N, and its place relative to the first layer."""

    wires: IntArray
    width_mm: float
    height_mm: float
    sign: float


def _layers(phantom: WirePhantom) -> list[_WireLayer]:
    if len(phantom.n_shapes) < 2:
        raise InvalidInputError(f"phantom: expected two N of wires or more, got {len(phantom.n_shapes)}")
    shapes = np.array(phantom.n_shapes)
    along, begins = phantom.directions[shapes[0, 0]], phantom.points_mm[shapes[:, 0]]
    across = phantom.points_mm[shapes[:, 2]] - begins
    across -= np.outer(across @ along, along)
    widths = np.linalg.norm(across, axis=1)
    axis = across[0] / widths[0]
    heights, signs = (begins - begins[0]) @ np.cross(along, axis), np.sign(across @ axis)
    return [_WireLayer(*values) for values in zip(shapes, widths, heights, signs, strict=True)]


def _triples(dots_mm: FloatArray, layer: _WireLayer, phantom: WirePhantom) -> IntArray:
    """Dots that may be a layer's first, middle and last wire, shape (t, 3)."""
    place = dots_mm @ [1.0, 1j]
    between = place[None] - place[:, None]
    length = np.abs(between)
    # Axes: first, last and middle dot.
    relative = np.conj(between / np.where(length > 0, length, np.inf))[..., None] * between[:, None]
    reach, off, ratio = relative.real, np.abs(relative.imag), length / layer.width_mm
    long = ((ratio > _WIDTHS[0]) & (ratio < _WIDTHS[1]))[..., None]
    inner, straight = (reach > _LEAST_MM) & (reach < length[..., None] - _LEAST_MM), off < _COLLINEAR_MM
    first, last, middle = np.nonzero(long & inner & straight)
    if len(first):
        return np.stack([first, middle, last], axis=1)
    if (long & inner).any():
        why = f"the middle one is {off[long & inner].min():.1f} mm off it, {_COLLINEAR_MM:g} allowed"
    else:
        why = _off_by(np.broadcast_to(ratio[..., None], inner.shape)[inner & straight], _WIDTHS)
    names = "-".join(phantom.names[k] for k in layer.wires)
    raise InsufficientDataError(f"no three dots in a line for a layer ({names}): {why}")


def _off_by(ratio: FloatArray, limits: tuple[float, float]) -> str:
    """How far the nearest of some distances is from what is allowed, in words."""
    if ratio.size == 0:
        return "none are in line"
    nearest = ratio[np.argmin(np.maximum(limits[0] - ratio, ratio - limits[1]))]
    side = "wider" if nearest > 1 else "narrower"
    return f"spacing {100 * abs(nearest - 1.0):.0f} % {side} than the wires'"


def _combine(
    triples: list[IntArray], dots_mm: FloatArray, score: FloatArray, layers: list[_WireLayer]
) -> IntArray:
    """Hypotheses: parallel triples at the layers' distances, shape (h, 3 layers)."""
    hypotheses, place = triples[0], dots_mm @ [1.0, 1j]
    for layer, below in zip(layers[1:], triples[1:], strict=True):
        upper, lower = (place[triple[:, 2]] - place[triple[:, 0]] for triple in (hypotheses, below))
        away = place[below[:, [0, 2]]].mean(axis=1) - place[hypotheses[:, [0, 2]]].mean(axis=1)[:, None]
        upper = np.conj(upper / np.abs(upper))[:, None]
        cosine = np.clip((upper * lower / np.abs(lower)).real * layers[0].sign * layer.sign, -1.0, 1.0)
        ratio = np.abs((upper * away).imag) / abs(layer.height_mm - layers[0].height_mm)
        disjoint = (hypotheses[:, None, :, None] != below[None, :, None, :]).all(axis=(2, 3))
        parallel = (cosine > _PARALLEL_COSINE) & disjoint
        first, second = np.nonzero(parallel & (ratio > _GAPS[0]) & (ratio < _GAPS[1]))
        if len(first) == 0:
            why = "the same row of dots would serve two layers"
            if parallel.any():
                why = _off_by(ratio[parallel], _GAPS)
            elif disjoint.any():
                turn, limit = np.rad2deg(np.arccos([cosine[disjoint].max(), _PARALLEL_COSINE]))
                why = f"the nearest are turned by {turn:.0f} degrees, {limit:.0f} allowed"
            raise InsufficientDataError(f"no parallel lines of dots at the layers' distances: {why}")
        hypotheses = np.concatenate([hypotheses[first], below[second]], axis=1)
        strongest = np.argsort(-score[hypotheses].sum(axis=1), kind="stable")
        hypotheses = hypotheses[strongest[:_MOST_HYPOTHESES]]
    return hypotheses


def misfits_mm(dots_mm: FloatArray, wires: IntArray, phantom: WirePhantom) -> FloatArray:
    """Root mean square components of dots' distances from wires, for the image that fits best.

    Equations are linear in the image's origin and its two axes, which may be of any lengths and at any angle.

    Parameters
    ----------
    dots_mm : ndarray, shape (b, m, 2)
        Of many hypotheses.
    wires : ndarray of int, shape (m,)

    Returns
    -------
    ndarray, shape (b,)
    """
    places = dots_mm - dots_mm.mean(axis=1, keepdims=True)
    rows, offsets = phantom.equations(wires)
    matrix = affine_equations(places, np.broadcast_to(rows, (len(places), *rows.shape)))
    matrix, target = matrix.reshape(len(places), -1, 9), offsets.ravel()
    normal = np.swapaxes(matrix, 1, 2) @ matrix + _RIDGE_MM2 * np.eye(9)
    image = np.linalg.solve(normal, (target @ matrix)[..., None])
    return np.asarray(np.sqrt(np.mean(((matrix @ image)[..., 0] - target) ** 2, axis=1)))
