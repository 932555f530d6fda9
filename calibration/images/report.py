"""Figures of a calibration from two crossing sweeps: images beside reslices, similarity about the answer.

References
----------
.. [1] W. Wein and A. Khamene, "Image-based method for in-vivo freehand ultrasound calibration", SPIE Medical
   Imaging 6920, 2008.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.spatial.transform import RigidTransform

from calibration.images.angulation import PARAMETERS, Angulation
from calibration.images.fit import Estimate
from calibration.images.search import incremented
from calibration.images.similarity import CrossingSweeps
from calibration.images.stacks import TrackedImages
from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.images import ChosenImages
from speckle3d.imaging.reslice import image_plane, resample_image, reslice_frames

PIXEL_MM = 0.15
_COLOURS = ("#0072B2", "#D55E00", "#009E73")
_REACH_MM = 1.5

IMAGES, SIGMA_MM = 10, 1.0
"""Images of each sweep, and their blur, in the similarity curves."""


@dataclass(frozen=True)
class SimilarityCurves:
    """Mean correlation of images with cuts of the other sweep, one parameter moved at a time.

    Attributes
    ----------
    offset : ndarray, shape (k,)
        Degrees for the first three axes, mm for the others.
    similarity : ndarray, shape (6, k)
        By `PARAMETERS`; NaN where no image overlaps the other sweep by three tenths.
    """

    offset: FloatArray
    similarity: FloatArray


@dataclass(frozen=True)
class SimilarityMap:
    """Mean correlation with two parameters moved at once, shape (k, k), the first along the first axis."""

    axes: tuple[str, str]
    offset: FloatArray
    similarity: FloatArray


def similarity_curves(
    crossing: CrossingSweeps,
    sensor_from_image: RigidTransform,
    span: float = 10.0,
    points: int = 21,
    scales: FloatArray | None = None,
    threads: int = 2,
) -> SimilarityCurves:
    """Similarity from -`span` to `span` mm or degrees about a calibration, along each of `PARAMETERS`.

    Parameters move the image at its origin, not about its centre.
    """
    offset = _offsets(span, points)
    steps = (step * np.eye(6)[axis] for axis in range(6) for step in offset)
    found = _similarities(crossing, _estimate(sensor_from_image, scales), steps, threads)
    return SimilarityCurves(offset, found.reshape(6, points))


def similarity_map(
    crossing: CrossingSweeps,
    sensor_from_image: RigidTransform,
    axes: tuple[str, str],
    span: float = 10.0,
    points: int = 21,
    scales: FloatArray | None = None,
    threads: int = 2,
) -> SimilarityMap:
    """Similarity over two parameters, named as in `PARAMETERS`."""
    for name in axes:
        if name not in PARAMETERS:
            raise InvalidInputError(f"axes: expected two of {', '.join(PARAMETERS)}, got {name!r}")
    offset = _offsets(span, points)
    one, other = (np.eye(6)[PARAMETERS.index(name)] for name in axes)
    steps = (a * one + b * other for a in offset for b in offset)
    found = _similarities(crossing, _estimate(sensor_from_image, scales), steps, threads)
    return SimilarityMap(axes, offset, found.reshape(points, points))


def _similarities(
    crossing: CrossingSweeps, about: Estimate, steps: Iterator[FloatArray], threads: int
) -> FloatArray:
    comparison = crossing.whole(SIGMA_MM, IMAGES, about.sensor_from_image)

    def at(step: FloatArray) -> float:
        moved = incremented(about, step)
        return comparison.at(moved.sensor_from_image, moved.scales).mean

    with ThreadPoolExecutor(threads) as pool:
        return np.array(list(pool.map(at, steps)))


def _offsets(span: float, points: int) -> FloatArray:
    if not (np.isfinite(span) and span > 0 and points >= 2):
        raise InvalidInputError(
            f"expected a span above zero and at least two points, got {span:g} and {points}"
        )
    return np.linspace(-span, span, points)


def _estimate(sensor_from_image: RigidTransform, scales: FloatArray | None) -> Estimate:
    return Estimate(sensor_from_image, np.ones(2) if scales is None else scales)


@dataclass(frozen=True)
class Pictures:
    """An image and what the other sweep shows in its place, at the start and at the answer.

    Attributes
    ----------
    image, before, after : ndarray, shape (rows, columns)
        NaN where nothing is shown.
    width_mm, height_mm : float
    title : str
    """

    image: Float32Array
    before: Float32Array
    after: Float32Array
    width_mm: float
    height_mm: float
    title: str


def pictures(
    shown: TrackedImages, other: TrackedImages, frame: int, start: RigidTransform, found: RigidTransform
) -> Pictures:
    """Cut the plane of one image out of the other sweep, with either calibration."""
    grid, frames = shown.grid, other.covered()
    sensor = shown.world_from_sensor(np.array([frame]))[0]
    cuts = []
    for mounting in (start, found):
        poses = other.world_from_sensor(frames) * mounting
        plane = image_plane(sensor * mounting, grid, PIXEL_MM)
        source = ChosenImages(other.images, frames)
        cuts.append(reslice_frames(source, other.grid, poses, plane, _reach_mm(poses)))
    own = resample_image(shown.images, frame, grid, PIXEL_MM)
    height = grid.depth_mm - grid.first_sample_depth_mm
    return Pictures(own, cuts[0], cuts[1], grid.width_mm, height, f"{shown.name}, frame {frame}")


def figure_images(
    shown: Sequence[Pictures],
    angulation: Angulation,
    curves: SimilarityCurves,
    maps: Sequence[SimilarityMap],
    title: str,
) -> Figure:
    """One page: images beside reslices before and after, similarity curves and maps, strength of the sweeps.

    The maps are Figure 4 of [1]_.

    References
    ----------
    .. [1] Wein and Khamene, SPIE Medical Imaging 6920, 2008.
    """
    figure = Figure(figsize=(12.0, 4.0 * len(shown) + 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    rows = len(shown)
    panels = figure.subplots(rows + 2, 3, squeeze=False, height_ratios=[1.3] * rows + [1.0, 1.0])
    for row, each in zip(panels, shown, strict=False):
        for axes, image, what in zip(
            row,
            (each.image, each.before, each.after),
            (each.title, "the other sweep there, before", "the other sweep there, after"),
            strict=True,
        ):
            _draw_image(axes, image, each, what)
    for axes, first, unit in ((panels[rows, 0], 3, "mm"), (panels[rows, 1], 0, "degrees")):
        for k, colour in zip(range(first, first + 3), _COLOURS, strict=True):
            axes.plot(curves.offset, curves.similarity[k], color=colour, label=PARAMETERS[k])
        _label(axes, f"off the answer / {unit}", "mean correlation")
        axes.legend(fontsize=8)
    _draw_strength(panels[rows, 2], angulation)
    for axes, found in zip(panels[-1], maps, strict=False):
        _draw_map(axes, found)
    figure.suptitle(title, fontsize=10)
    return figure


def _reach_mm(poses: RigidTransform) -> float:
    """A little more than the distance between frames deep in a fan."""
    steps = np.linalg.norm(np.diff(poses.apply([0.0, 40.0, 0.0]), axis=0), axis=1)
    return max(_REACH_MM, 1.5 * float(np.percentile(steps, 98))) if len(steps) else _REACH_MM


def _draw_image(axes: Axes, image: Float32Array, of: Pictures, title: str) -> None:
    grey = of.image[np.isfinite(of.image)]
    low, high = np.percentile(grey, [2.0, 99.5]) if grey.size else (0.0, 1.0)
    extent = (0.0, of.width_mm, of.height_mm, 0.0)
    axes.set_facecolor("#22303c")
    axes.imshow(image, cmap="gray", vmin=low, vmax=high, extent=extent, interpolation="bilinear")
    axes.set_title(title, fontsize=8)
    axes.tick_params(labelsize=7)


def _draw_map(axes: Axes, found: SimilarityMap) -> None:
    across, up = found.axes
    drawn = axes.contourf(found.offset, found.offset, found.similarity.T, 16, cmap="viridis")
    axes.figure.colorbar(drawn, ax=axes, label="mean correlation")
    axes.plot(0.0, 0.0, "+", color="white")
    _label(axes, f"{across} / {_unit_of(across)}", f"{up} / {_unit_of(up)}")


def _unit_of(axis: str) -> str:
    return "mm" if axis in ("x", "y", "z") else "degrees"


def _draw_strength(axes: Axes, angulation: Angulation) -> None:
    """Disagreement caused by each error, by itself and with the other parameters free to make up for it."""
    place = np.arange(len(PARAMETERS))
    axes.bar(place - 0.2, angulation.alone, 0.4, color=_COLOURS[0], label="by itself")
    axes.bar(place + 0.2, angulation.recoverable, 0.4, color=_COLOURS[1], label="others free")
    axes.set_xticks(place, [f"{name}\n/ {'°' if k < 3 else 'mm'}" for k, name in enumerate(PARAMETERS)])
    _label(axes, "error", "disagreement / mm")
    axes.legend(fontsize=8)


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)
