"""Figures of a study, drawn without pyplot: no window system, no global state."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.io.hdf5 import atomic_path, make_folder
from speckle3d.scoring.lengths import JITTER_FRAMES, accumulated

DOTS_PER_INCH = 150

MODE_COLOURS = {
    "image": "#D55E00",
    "image+subset": "#E69F00",
    "orientation": "#0072B2",
    "pose": "#009E73",
    "crossed": "#CC79A7",
}
"""Okabe and Ito's palette, told apart with any colour vision; the reference is black."""

MODE_LABELS = {
    "image": "image-based",
    "image+subset": "image-based, consistent subset",
    "orientation": "orientation correction",
    "pose": "six DOF correction",
    "crossed": "crossed-sweep correction",
}

_MODE_STYLES = {"image": "-", "orientation": "--", "pose": "-.", "crossed": (0, (1, 1))}
"""A second cue beside colour: corrected curves often lie on each other."""

_LETTER_IN = 0.085
"""Width of a letter of medium size."""

_FEWEST_LETTERS = 12
"""In a line: the longest word."""


def figure_drift(
    poses: Mapping[str, RigidTransform],
    centre_mm: npt.ArrayLike,
    reference: RigidTransform | None = None,
    covered: npt.ArrayLike | None = None,
    reference_name: str = "reference",
    title: str = "",
    covariance: FloatArray | None = None,
) -> Figure:
    """Draw accumulated elevational offset and tilt over the frames, for every mode and the reference.

    Parameters
    ----------
    poses : mapping of str to RigidTransform, length n
        ``world_from_image`` by mode.
    reference : RigidTransform, length n or the number of covered frames, optional
    covered : array_like of bool, shape (n,), optional
        Frames that have a reference.
    covariance : ndarray, shape (n, 6, 6), optional
        Of the poses of mode `image`, which gets a band of its 95 % intervals.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 6.
    """
    figure = _new_figure(10.0, 4.2)
    panels = figure.subplots(1, 2)
    curves = {mode: _length_and_tilt(each, centre_mm) for mode, each in poses.items()}
    if reference is not None:
        shown = _reference_curves(reference, covered, next(iter(curves.values())), centre_mm)
        _draw(panels, shown, color="black", linewidth=2.2, alpha=0.55, label=reference_name)
    if covariance is not None and "image" in curves:
        _shade(panels, curves["image"], covariance)
    for mode, curve in curves.items():
        colour, dashes = MODE_COLOURS.get(mode, "#56B4E9"), _MODE_STYLES.get(mode, "-")
        label = MODE_LABELS.get(mode, mode)
        _draw(panels, curve, color=colour, linestyle=dashes, linewidth=1.3, label=label)
    _label(panels[0], "frame", "elevational offset at the centre / mm")
    _label(panels[1], "frame", "accumulated tilt / degrees")
    panels[0].legend(frameon=False, fontsize="small")
    figure.suptitle(title)
    return figure


def _shade(panels: npt.NDArray[Any], curves: Any, covariance: FloatArray) -> None:
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    for panel, curve, sigma in zip(
        panels, curves, (deviation[:, 2], np.rad2deg(deviation[:, 3])), strict=True
    ):
        frames = np.arange(len(curve))
        low, high = curve - 1.96 * sigma, curve + 1.96 * sigma
        panel.fill_between(
            frames, low, high, color=MODE_COLOURS["image"], alpha=0.15, linewidth=0, label="95 % of image"
        )


def figure_reslice(
    images_db: Mapping[str, npt.NDArray[np.floating]],
    extents_mm: Mapping[str, tuple[float, float, float, float]],
    dynamic_range_db: float = 50.0,
    title: str = "",
    axis_labels: tuple[str, str] = ("elevational / mm", "depth / mm"),
) -> Figure:
    """Draw grey reslices of every mode side by side, at one scale.

    Parameters
    ----------
    images_db : mapping of str to ndarray, shape (rows, columns)
        Reslice by mode, dB; NaN where no frame reached, drawn in blue-grey.
    extents_mm : mapping of str to (left, right, bottom, top)
        Edges of each image, as in matplotlib's `imshow`; bottom > top where depth grows downwards.
    dynamic_range_db : float
        Below the brightest value of all images.
    """
    if not images_db:
        raise InvalidInputError("images_db: expected at least one reslice, got none")
    if set(images_db) != set(extents_mm):
        raise MismatchError(
            f"extents_mm: expected the modes {sorted(images_db)}, got those of {sorted(extents_mm)}"
        )
    widths = [abs(extents_mm[mode][1] - extents_mm[mode][0]) for mode in images_db]
    height = max(abs(extents_mm[mode][3] - extents_mm[mode][2]) for mode in images_db)
    figure = _new_figure(*_reslice_size(widths, height))
    panels = figure.subplots(
        1, len(images_db), squeeze=False, sharey=True, width_ratios=[max(w, 0.2 * height) for w in widths]
    )[0]
    brightest = _brightest(images_db)
    greys = colormaps["gray"].with_extremes(bad="#33415c")
    for panel, (mode, image) in zip(panels, images_db.items(), strict=True):
        panel.imshow(image, cmap=greys, vmin=brightest - dynamic_range_db, vmax=brightest, aspect="equal",
                     extent=extents_mm[mode], interpolation="nearest")  # fmt: skip
        title = wrapped(MODE_LABELS.get(mode, mode), figure.get_figwidth() / len(images_db))
        panel.set_title(title, fontsize="medium", color=MODE_COLOURS.get(mode, "black"))
        panel.set_xlabel(axis_labels[0])
    panels[0].set_ylabel(axis_labels[1])
    figure.suptitle(title)
    return figure


def wrapped(title: str, width_in: float) -> str:
    """Title in lines that fit above a panel, and do not run into its neighbour's."""
    return textwrap.fill(title, max(_FEWEST_LETTERS, int(width_in / _LETTER_IN)), break_on_hyphens=False)


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a PNG; it appears whole or not at all.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    make_folder(path.parent)
    with atomic_path(path) as part:
        figure.savefig(part, dpi=DOTS_PER_INCH, format="png")
    return path


def _new_figure(width_in: float, height_in: float) -> Figure:
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _draw(panels: npt.NDArray[np.object_], curves: FloatArray, **style: Any) -> None:
    for panel, curve in zip(panels, curves, strict=True):
        panel.plot(curve, **style)


def _length_and_tilt(poses: RigidTransform, centre_mm: npt.ArrayLike) -> FloatArray:
    """Accumulated length, mm, and tilt, degrees, shape (2, n)."""
    motion = accumulated(poses, centre_mm)
    return np.stack([motion.length_mm, np.rad2deg(motion.tilt_rad)])


def _reference_curves(
    reference: RigidTransform,
    covered: npt.ArrayLike | None,
    estimate: FloatArray,
    centre_mm: npt.ArrayLike,
) -> FloatArray:
    """Length and tilt of the reference, NaN where it has none.

    A sum from the first reading would carry that reading's jitter along the whole trace, so the trace starts
    at the estimate's level over the first few readings.
    """
    used = np.ones(estimate.shape[1], dtype=bool) if covered is None else np.asarray(covered, dtype=bool)
    if used.shape != estimate.shape[1:] or len(reference) not in (used.size, used.sum()):
        raise MismatchError(
            f"reference: expected {used.sum()} poses for {estimate.shape[1]} frames, got {len(reference)}"
        )
    curves = _length_and_tilt(reference[used] if len(reference) == used.size else reference, centre_mm)
    start = (curves - estimate[:, used])[:, :JITTER_FRAMES]
    shown = np.full(estimate.shape, np.nan)
    shown[:, used] = curves - np.median(start, axis=1, keepdims=True)
    return shown


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(visible=True, alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def _reslice_size(widths_mm: list[float], height_mm: float) -> tuple[float, float]:
    """Size in inches that fits the panels, ten inches wide at most and eight high."""
    total = sum(max(w, 0.2 * height_mm) for w in widths_mm)
    scale = min(9.0 / total, 6.5 / height_mm)
    return max(scale * total + 1.2, 4.0), scale * height_mm + 1.3


def _brightest(images: Mapping[str, npt.NDArray[np.floating]]) -> float:
    finite: FloatArray = np.concatenate([image[np.isfinite(image)] for image in images.values()])
    if not finite.size:
        raise InvalidInputError("images_db: expected a finite value in some reslice, got none")
    # The 99.9th percentile: a single specular echo must not darken the tissue.
    return float(np.percentile(finite, 99.9))
