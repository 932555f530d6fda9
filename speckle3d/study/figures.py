"""Figures of a reconstruction: what is drawn (series, labels, colours), and how matplotlib draws it.

The report draws the same series by plotly as well. Nothing here needs pyplot or a window system.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from speckle3d.core.arrays import FloatArray
from speckle3d.core.printable import printable
from speckle3d.io.hdf5 import atomic_path, make_folder
from speckle3d.scoring.references import REFERENCES, SweepCurves

DOTS_PER_INCH = 150
CURVE_LABELS = ("length / mm", "tilt / °", "yaw / °", "roll / °")

_MODES = {
    "image": ("images alone", "#D55E00"),
    "consistent-subset": ("consistent subset", "#E69F00"),
    "orientation": ("with orientation sensor", "#0072B2"),
    "pose": ("with position sensor", "#009E73"),
    "crossed": ("with crossing sweep", "#CC79A7"),
    "inertial": ("with accelerometer", "#56B4E9"),
    "fused": ("all sensors, fused", "#882255"),
}
"""Label and colour of each mode, from Okabe and Ito's and Tol's palettes, told apart with any vision."""

_INTERVAL = ("95 % interval of the image-based length", *["95 % interval of the image-based angle"] * 3)
_SPARE_COLOURS = ("#F0E442", "#999999", "#44AA99")
_REFERENCE_COLOUR = "#000000"
UNSEEN = "#33415c"
"""Blue-grey of a reslice's pixels that no frame reached."""

_DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (3, 1, 1, 1, 1, 1)))
"""A second cue beside colour: corrected curves often lie on each other."""

_STYLES: Mapping[str, Mapping[str, Any]] = {
    "line": {"linewidth": 1.3},
    "reference": {"linewidth": 2.4, "alpha": 0.5},
    "band": {"linewidth": 0, "alpha": 0.15},
    "points": {"linestyle": "none", "marker": "o", "markersize": 4, "alpha": 0.7},
    "dotted": {"linewidth": 0.8, "marker": ".", "markersize": 3},
    "bar": {"linewidth": 6, "alpha": 0.25},
}
Style = Literal["line", "reference", "band", "points", "dotted", "bar"]

_LETTER_IN = 0.085
"""Width of a letter of medium size."""

_FEWEST_LETTERS = 12
"""Letters that a line of a title has at least: those of the longest word."""


@dataclass(frozen=True)
class Series:
    """One thing that a panel shows.

    Attributes
    ----------
    points : ndarray, shape (n, 2) or (n, 3)
        NaN breaks a line.
    low : ndarray, shape (n,), optional
        Lower edge of a band; `points` are the upper one.
    dash : int
        Which pattern of dashes a line has.
    words : sequence of str
        What each point is.
    """

    label: str
    colour: str
    points: FloatArray
    style: Style = "line"
    low: FloatArray | None = None
    dash: int = 0
    words: Sequence[str] = ()


@dataclass(frozen=True)
class Panel:
    """Series on the same axes.

    Attributes
    ----------
    axes : tuple of str
        Name and unit of each coordinate.
    levels : sequence of str
        Names of the heights 0, 1, ... from the top, in place of numbers.
    limits : (low, high), optional
        Of the vertical axis.
    """

    series: Sequence[Series]
    axes: tuple[str, ...]
    levels: Sequence[str] = ()
    limits: tuple[float, float] | None = None


def label_of(mode: str) -> str:
    """Words for a mode."""
    return _MODES[mode][0] if mode in _MODES else mode


def colour_of(mode: str, modes: Sequence[str] = ()) -> str:
    """Colour of a mode, the same in all figures; the reference is black."""
    if mode in REFERENCES:
        return _REFERENCE_COLOUR
    if mode in _MODES:
        return _MODES[mode][1]
    others = [m for m in modes if m not in _MODES]
    return _SPARE_COLOURS[others.index(mode) % len(_SPARE_COLOURS) if mode in others else 0]


def curve_panels(
    curves: SweepCurves,
    count: int = len(CURVE_LABELS),
    frames: npt.NDArray[np.integer] | None = None,
    minus_reference: bool = False,
) -> list[Panel]:
    """Panels of length, tilt, yaw and roll over the frames, for every mode and the reference.

    Parameters
    ----------
    count : int
        Panels, from length on.
    frames : ndarray of int, optional
        Frames to draw; by default all.
    minus_reference : bool
        Draw differences from the reference.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 6.
    """
    at = np.arange(curves.frames) if frames is None else frames

    def over_frames(values: FloatArray) -> FloatArray:
        return np.column_stack([at, values[at]])

    panels = []
    for q in range(count):
        zero = np.zeros(curves.frames)
        if minus_reference and curves.reference is not None:
            zero = curves.reference[q]
        series = []
        if curves.reference is not None:
            level = over_frames(curves.reference[q] - zero)
            series.append(Series(curves.reference_name, _REFERENCE_COLOUR, level, "reference"))
        if curves.half_width is not None:
            middle, half = curves.modes["image"][q] - zero, curves.half_width[q]
            name = _INTERVAL[q]
            band = over_frames(middle + half)
            series.append(Series(name, colour_of("image"), band, "band", (middle - half)[at]))
        for i, (mode, values) in enumerate(curves.modes.items()):
            colour = colour_of(mode, list(curves.modes))
            series.append(Series(label_of(mode), colour, over_frames(values[q] - zero), dash=i))
        panels.append(Panel(series, ("frame", CURVE_LABELS[q])))
    return panels


def figure_drift(curves: SweepCurves, title: str = "") -> Figure:
    """Draw accumulated length and tilt over the frames, for every mode and the reference."""
    figure = figure_panels(curve_panels(curves, 2), 2, (10.0, 4.2))
    name_figure(figure, title)
    return figure


def name_figure(figure: Figure, title: str) -> None:
    """Put a name over a figure as it is: a dollar in the name of a file begins no formula."""
    figure.suptitle(printable(title, kept="\n"), parse_math=False)


def figure_panels(panels: Sequence[Panel], columns: int, size_in: tuple[float, float]) -> Figure:
    """Draw panels in rows of `columns`; panels below each other share the horizontal axis."""
    figure = new_figure(*size_in)
    rows = -(-len(panels) // columns)
    named = bool(panels[0].levels)
    places = figure.subplots(rows, columns, squeeze=False, sharex="col" if rows > 1 else False, sharey=named)
    for i, (panel, axes) in enumerate(zip(panels, places.ravel(), strict=True)):
        draw_panel(axes, panel, i + columns >= len(panels))
    if named:
        places[0, 0].set_yticks(range(len(panels[0].levels)), panels[0].levels)
        places[0, 0].invert_yaxis()
    else:
        places[0, 0].legend(frameon=False, fontsize="small")
    return figure


def draw_panel(axes: Axes, panel: Panel, named_below: bool = True) -> None:
    """Draw one panel."""
    if panel.levels:
        axes.axvline(0.0, color="0.6", linewidth=0.8)
    for each in panel.series:
        look: dict[str, Any] = {"color": each.colour, "label": each.label, **_STYLES[each.style]}
        if each.low is not None:
            axes.fill_between(each.points[:, 0], each.low, each.points[:, 1], **look)
        else:
            axes.plot(*each.points.T, **{"linestyle": _DASHES[each.dash % len(_DASHES)], **look})
    if panel.limits:
        axes.set_ylim(*panel.limits)
    label_axes(axes, panel.axes[0] if named_below else "", panel.axes[1])
    axes.grid(visible=True, alpha=0.3)


def show_grey(
    axes: Axes,
    image: npt.NDArray[np.floating],
    extent_mm: tuple[float, float, float, float],
    levels: tuple[float, float],
) -> None:
    """Draw an image in grey from the first of the levels (black) to the second; blue-grey where it is NaN."""
    greys = colormaps["gray"].with_extremes(bad=UNSEEN)
    axes.imshow(image, cmap=greys, vmin=levels[0], vmax=levels[1], aspect="equal", extent=extent_mm,
                interpolation="nearest")  # fmt: skip


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
    figure.set_dpi(DOTS_PER_INCH)
    with atomic_path(path) as part:
        # `savefig` would draw everything twice, the first time for the layout alone.
        FigureCanvasAgg(figure).print_png(part)  # type: ignore[no-untyped-call]
    return path


def new_figure(
    width_in: float, height_in: float, layout: Literal["constrained", "compressed"] | None = "constrained"
) -> Figure:
    """Make a figure that needs no window system."""
    figure = Figure(figsize=(width_in, height_in), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def label_axes(axes: Axes, x: str, y: str) -> None:
    """Name the axes and leave out the frame at the top and the right."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.spines[["top", "right"]].set_visible(False)
