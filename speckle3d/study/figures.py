"""Figures of a reconstruction in files, by matplotlib without pyplot or a window system; colours of modes."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from speckle3d.core.text import printable
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

UNSEEN = "#33415c"
"""Blue-grey of a reslice's pixels that no frame reached."""

_DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (3, 1, 1, 1, 1, 1)))
"""A second cue beside colour: corrected curves often lie on each other."""


def label_of(mode: str) -> str:
    """Name of a mode in figures: its own."""
    return "tracker alone" if mode == "tracker" else mode


def colour_of(mode: str) -> str:
    """Colour of a mode, the same in all figures; dark grey of a volume and of modes that older files hold."""
    return _COLOURS.get(mode, "#404040")


def figure_drift(curves: SweepCurves, title: str = "") -> Figure:
    """Draw accumulated length and tilt over the frames, for every mode and the reference.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 6.
    """
    figure, frames = new_figure(11.5, 4.2), np.arange(curves.frames)
    for q, axes in enumerate(figure.subplots(1, 2)):
        if curves.reference is not None:
            look = {"color": colour_of(curves.reference_name), "label": curves.reference_name}
            axes.plot(frames, curves.reference[q], linewidth=2.4, **look)
        if curves.half_width is not None:
            middle, half = curves.modes["image"][q], curves.half_width[q]
            look = {"color": colour_of("image"), "label": "95 % interval of image"}
            axes.fill_between(frames, middle - half, middle + half, linewidth=0, alpha=0.15, **look)
        for mode, dash in zip(curves.modes, cycle(_DASHES), strict=False):
            look = {"color": colour_of(mode), "label": label_of(mode)}
            axes.plot(frames, curves.modes[mode][q], linestyle=dash, linewidth=1.3, **look)
        axes.set(xlabel="frame", ylabel=CURVE_LABELS[q])
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(visible=True, alpha=0.3)
    figure.legend(
        *axes.get_legend_handles_labels(), loc="outside right upper", frameon=False, fontsize="small"
    )
    name_figure(figure, title)
    return figure


def name_figure(figure: Figure, title: str) -> None:
    """Put a name over a figure as it is, on one line: a dollar in the name of a file begins no formula."""
    letters = max(1.0, len(title) * 0.11 / figure.get_figwidth())
    figure.suptitle(printable(title), parse_math=False, fontsize=12 / letters)


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
    return Figure(figsize=(width_in, height_in), layout="constrained")
