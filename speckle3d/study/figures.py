"""Figures of a reconstruction: what is drawn (series, labels, colours), and how matplotlib draws it in files.

The report's page draws the same series by plotly. Nothing here needs pyplot or a window system.
"""

from __future__ import annotations

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
from matplotlib.image import AxesImage

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.printable import printable
from speckle3d.io.hdf5 import atomic_path, make_folder
from speckle3d.scoring.references import SweepCurves

DOTS_PER_INCH = 150
CURVE_LABELS = ("length / mm", "tilt / °", "yaw / °", "roll / °")

RANGE_DB = 50.0
"""Grey scale of all pictures: from the maximum, white, down to black. Speckle scatters by 5.6 dB."""

_COLOURS = {
    "truth": "#000000",
    "tracker": "#808080",
    "image": "#D55E00",
    "consistent-subset": "#E69F00",
    "orientation": "#0072B2",
    "pose": "#009E73",
    "crossed": "#CC79A7",
    "fused": "#882255",
}
"""From Okabe and Ito's and Tol's palettes, told apart with any vision."""

_SPARE_COLOURS = ("#F0E442", "#56B4E9", "#44AA99")
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
    """Name of a mode in figures: its own."""
    return "tracker alone" if mode == "tracker" else mode


def colour_of(mode: str, modes: Sequence[str] = ()) -> str:
    """Colour of a mode, the same in all figures; the truth is black."""
    others = [m for m in modes if m not in _COLOURS]
    spare = _SPARE_COLOURS[others.index(mode) % len(_SPARE_COLOURS) if mode in others else 0]
    return _COLOURS.get(mode, spare)


def spread_frames(count: int, most: int) -> IntArray:
    """Frames to draw: every one of a short sweep, evenly spread ones of a long one, both ends included."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


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
    panels = []
    for q in range(count):
        zero = np.zeros(curves.frames)
        if minus_reference and curves.reference is not None:
            zero = curves.reference[q]

        def shown(values: FloatArray, zero: FloatArray = zero) -> FloatArray:
            return np.column_stack([at, (values - zero)[at]])

        series = []
        if curves.reference is not None:
            name = curves.reference_name
            series.append(Series(name, colour_of(name), shown(curves.reference[q]), "reference"))
        if curves.half_width is not None:
            middle, half = curves.modes["image"][q], curves.half_width[q]
            low, high = shown(middle - half)[:, 1], shown(middle + half)
            series.append(Series("95 % interval of image", colour_of("image"), high, "band", low))
        for i, (mode, values) in enumerate(curves.modes.items()):
            colour = colour_of(mode, list(curves.modes))
            series.append(Series(label_of(mode), colour, shown(values[q]), dash=i))
        panels.append(Panel(series, ("frame", CURVE_LABELS[q])))
    return panels


def figure_drift(curves: SweepCurves, title: str = "") -> Figure:
    """Draw accumulated length and tilt over the frames, for every mode and the reference."""
    return figure_panels(curve_panels(curves, 2), 2, (10.0, 4.2), title)


def figure_panels(
    panels: Sequence[Panel], columns: int, size_in: tuple[float, float], title: str = ""
) -> Figure:
    """Draw panels in rows of `columns`; panels below each other share the horizontal axis."""
    figure = new_figure(*size_in)
    rows = -(-len(panels) // columns)
    named = bool(panels[0].levels)
    places = figure.subplots(rows, columns, squeeze=False, sharex="col" if rows > 1 else False, sharey=named)
    for i, (panel, axes) in enumerate(zip(panels, places.ravel(), strict=True)):
        _draw_panel(axes, panel, i + columns >= len(panels))
    if named:
        places[0, 0].set_yticks(range(len(panels[0].levels)), panels[0].levels)
        places[0, 0].invert_yaxis()
    name_figure(figure, title)
    return figure


def name_figure(figure: Figure, title: str) -> None:
    """Put a name over a figure as it is, on one line: a dollar in the name of a file begins no formula."""
    letters = max(1.0, len(title) * 0.11 / figure.get_figwidth())
    figure.suptitle(printable(title), parse_math=False, fontsize=12 / letters)


def show_grey(
    axes: Axes,
    image: npt.NDArray[np.floating],
    extent_mm: tuple[float, float, float, float],
    levels: tuple[float, float],
) -> AxesImage:
    """Draw an image in grey from the first of the levels (black) to the second; blue-grey where it is NaN."""
    greys = colormaps["gray"].with_extremes(bad=UNSEEN)
    return axes.imshow(image, cmap=greys, vmin=levels[0], vmax=levels[1], aspect="equal", extent=extent_mm,
                       interpolation="nearest")  # fmt: skip


def save_figure(figure: Figure, path: Path, words: Mapping[str, str] | None = None) -> Path:
    """Write a PNG, with texts by keyword; it appears whole or not at all.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    make_folder(path.parent)
    figure.set_dpi(DOTS_PER_INCH)
    with atomic_path(path) as part:
        # `savefig` would draw everything twice, the first time for the layout alone.
        FigureCanvasAgg(figure).print_png(part, metadata=words)  # type: ignore[no-untyped-call]
    return path


def new_figure(width_in: float, height_in: float) -> Figure:
    """Make a figure that needs no window system."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _draw_panel(axes: Axes, panel: Panel, named_below: bool) -> None:
    if panel.levels:
        axes.axvline(0.0, color="0.6", linewidth=0.8)
    for each in panel.series:
        look: dict[str, Any] = {"color": each.colour, "label": each.label, **_STYLES[each.style]}
        if each.low is not None:
            axes.fill_between(each.points[:, 0], each.low, each.points[:, 1], **look)
        else:
            axes.plot(*each.points.T, **{"linestyle": _DASHES[each.dash % len(_DASHES)], **look})
    if not panel.levels:
        axes.legend(frameon=False, fontsize="small")
    axes.set(xlabel=panel.axes[0] if named_below else "", ylabel=panel.axes[1])
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, alpha=0.3)
