"""The report's figures as they are printed and filed: PNG and SVG, drawn without a window system."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import ImageGrid
from speckle3d.io.hdf5 import atomic_path, make_folder
from speckle3d.report.data import RejectedPatches, SweepCurves
from speckle3d.report.reslices import Cut, Cuts
from speckle3d.study.figures import DOTS_PER_INCH, MODE_COLOURS, MODE_LABELS, wrapped
from speckle3d.study.job import REFERENCES
from speckle3d.study.overall import mean_over_sweeps

MOST_POINTS = 240
"""Points of a curve: more than print or screen resolve, and each costs bytes."""

OUTLINES = 20
"""Frames whose outlines are drawn."""

CURVE_LABELS = ("length / mm", "tilt / °", "yaw / °", "roll / °")

_SPARE_COLOURS = ("#CC79A7", "#56B4E9", "#E69F00", "#F0E442")
_DASHES = ("-", "--", "-.", ":", (0, (3, 1, 1, 1, 1, 1)))
_BLANK = "#33415c"


def label_of(mode: str) -> str:
    """Words for a mode."""
    return MODE_LABELS.get(mode, mode)


def colour_of(mode: str, modes: Sequence[str] = ()) -> str:
    """Colour of a mode, the same wherever it appears; the reference is black."""
    if mode in REFERENCES:
        return "#000000"
    if mode in MODE_COLOURS:
        return MODE_COLOURS[mode]
    others = [m for m in modes if m not in MODE_COLOURS]
    return _SPARE_COLOURS[others.index(mode) % len(_SPARE_COLOURS) if mode in others else 0]


def decimated(frames: int) -> npt.NDArray[np.int64]:
    """Frames to draw: every one of a short sweep, evenly spread ones of a long one, both ends included."""
    return np.unique(np.linspace(0, frames - 1, min(frames, MOST_POINTS)).round().astype(np.int64))


def outline(poses: RigidTransform, grid: ImageGrid) -> FloatArray:
    """Outlines of some frames as one broken line, shape (m, 3), mm: NaN between them."""
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), OUTLINES)).round().astype(int))
    closed = grid.corners_mm[[0, 1, 2, 3, 0]]
    breaks = np.full((1, 3), np.nan)
    return np.concatenate([np.concatenate([poses[int(i)].apply(closed), breaks]) for i in chosen])


def figure_overview(rows: Sequence[Mapping[str, Any]], modes: Sequence[str]) -> Figure:
    """Errors of length and tilt: a point for every part of every sweep, a bar at the mean magnitude."""
    figure = _figure(9.0, 1.3 + 0.5 * len(modes))
    panels = figure.subplots(1, 2, sharey=True)
    for panel, key, name in zip(
        panels,
        ("length_error_percent", "tilt_error_deg"),
        ("length error / %", "tilt error / °"),
        strict=True,
    ):
        panel.axvline(0.0, color="0.6", linewidth=0.8)
        for level, mode in enumerate(modes):
            mine = [row for row in rows if row["mode"] == mode and row.get(key) is not None]
            values = [row[key] for row in mine]
            spread = level + 0.3 * (np.arange(len(values)) / max(len(values) - 1, 1) - 0.5)
            panel.plot(values, spread, "o", color=colour_of(mode, modes), markersize=4, alpha=0.7)
            if values:
                size = mean_over_sweeps(mine, key)
                panel.plot(
                    [-size, size], [level, level], color=colour_of(mode, modes), linewidth=6, alpha=0.25
                )
        _label(panel, name, "")
    panels[0].set_yticks(range(len(modes)), [label_of(mode) for mode in modes])
    panels[0].invert_yaxis()
    return figure


def figure_curves(curves: SweepCurves) -> Figure:
    """Draw accumulated length, tilt, yaw and roll over the frames, for every mode and the reference.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 6.
    """
    figure = _figure(9.0, 6.0)
    panels = figure.subplots(2, 2, sharex=True).ravel()
    frames = decimated(curves.frames)
    for q, panel in enumerate(panels):
        if curves.reference is not None:
            panel.plot(frames, curves.reference[q][frames], color="black", linewidth=2.4, alpha=0.5,
                       label=curves.reference_name)  # fmt: skip
        if curves.half_width is not None:
            middle, half = curves.modes["image"][q][frames], curves.half_width[q][frames]
            panel.fill_between(frames, middle - half, middle + half, color=colour_of("image"), alpha=0.15,
                               linewidth=0, label=f"95 % of {label_of('image')}")  # fmt: skip
        for i, (mode, values) in enumerate(curves.modes.items()):
            panel.plot(frames, values[q][frames], color=colour_of(mode, [*curves.modes]), linewidth=1.3,
                       linestyle=_DASHES[i % len(_DASHES)], label=label_of(mode))  # fmt: skip
        _label(panel, "frame" if q > 1 else "", CURVE_LABELS[q])
    panels[0].legend(frameon=False, fontsize="small")
    return figure


def figure_outlines(poses: Mapping[str, RigidTransform], grid: ImageGrid, reference: str) -> Figure:
    """Draw the frames' outlines of every mode in space, the reference's in grey behind each."""
    shown = [mode for mode in poses if mode != reference] or list(poses)
    figure = _figure(3.1 * len(shown), 3.5)
    lines = {mode: outline(each, grid) for mode, each in poses.items()}
    everything = np.concatenate(list(lines.values()))
    low, high = np.nanmin(everything, axis=0), np.nanmax(everything, axis=0)
    for i, mode in enumerate(shown):
        axes: Any = figure.add_subplot(1, len(shown), i + 1, projection="3d")
        if reference in lines:
            _outline(axes, lines[reference], color="0.55", linewidth=0.8)
        _outline(axes, lines[mode], color=colour_of(mode, shown), linewidth=0.9)
        for axis, name in ((axes.xaxis, "elevational"), (axes.yaxis, "lateral"), (axes.zaxis, "depth")):
            axis.set_label_text(f"{name} / mm", fontsize="small")
            axis.set_major_locator(MaxNLocator(4))
        axes.set_title(wrapped(label_of(mode), 3.1), fontsize="medium", color=colour_of(mode, shown), y=0.95)
        axes.set_box_aspect(np.maximum(high - low, 0.15 * (high - low).max())[[2, 0, 1]], zoom=0.62)
        axes.tick_params(labelsize=6)
        axes.invert_zaxis()
        axes.view_init(elev=22, azim=-62)
    return figure


def figure_cuts(cuts: Cuts) -> Figure:
    """Reslices of all modes at one scale, each with its detail enlarged below."""
    modes = list(cuts.by_mode)
    widths = [max(cut.extent_mm[0], 0.45 * cut.extent_mm[1]) for cut in cuts.by_mode.values()]
    tall = max(cut.extent_mm[1] for cut in cuts.by_mode.values())
    scale = min(9.0 / sum(widths), 5.5 / tall)
    below = min(w * scale for w in widths) * 0.8
    figure = _figure(max(scale * sum(widths) + 1.2, 5.0), scale * tall + below + 1.4, "compressed")
    panels = figure.subplots(2, len(modes), squeeze=False, width_ratios=widths,
                             height_ratios=[scale * tall, below])  # fmt: skip
    for i, (mode, cut) in enumerate(cuts.by_mode.items()):
        _draw_cut(panels[0, i], panels[1, i], cut)
        title = wrapped(label_of(mode), cut.extent_mm[0] * scale + 0.4)
        panels[0, i].set_title(title, fontsize="medium", color=colour_of(mode, modes))
        panels[0, i].set_anchor("N")
    panels[0, 0].set_ylabel("depth from the top / mm")
    panels[1, 0].set_ylabel("enlarged")
    figure.supxlabel("along the sweep / mm", fontsize="medium")
    return figure


def figure_rejected(rejected: RejectedPatches, cuts: Cuts | None, grid: ImageGrid) -> Figure:
    """Where in the image patches were left out, over an image of the sweep, and how many in each frame.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 4.
    """
    figure = _figure(9.0, 4.0)
    image, sweep = figure.subplots(1, 2, width_ratios=[1.0, 1.5])
    if cuts is not None:
        right = (0.0, cuts.grid.width_mm, cuts.grid.depth_mm, cuts.grid.first_sample_depth_mm)
        image.imshow(
            cuts.middle.T, cmap="gray", extent=right, aspect="auto", vmin=0, vmax=255, rasterized=True
        )
    width, height = patch_size(rejected.centre_mm)
    corners = rejected.centre_mm - [width / 2, height / 2]
    boxes = PatchCollection(
        [Rectangle((x, y), width, height) for x, y in corners], cmap="viridis", alpha=0.55
    )
    boxes.set_array(np.ma.masked_invalid(100.0 * rejected.share))
    boxes.set_clim(0.0, 100.0)
    image.add_collection(boxes)
    image.set(xlim=(0.0, grid.width_mm), ylim=(grid.depth_mm, grid.first_sample_depth_mm), aspect="equal")
    figure.colorbar(boxes, ax=image, label="left out / % of the pairs")
    _label(image, "lateral / mm", "depth / mm", grid=False)
    frames = decimated(rejected.frame_share.size)
    sweep.plot(frames, 100.0 * rejected.frame_share[frames], ".-", color="0.25", linewidth=0.8, markersize=3)
    sweep.set_ylim(0.0, 100.0)
    _label(sweep, "frame", "patches left out / %")
    return figure


def patch_size(centre_mm: FloatArray) -> tuple[float, float]:
    """Width and height of the patches from the distances between their centres, mm."""
    gaps = [np.diff(np.unique(np.round(column, 6))) for column in centre_mm.T]
    sides = [float(gap.min()) if gap.size else 3.0 for gap in gaps]
    return sides[0], sides[1]


def save_both(figure: Figure, stem: Path) -> list[Path]:
    """Write ``stem.png`` and ``stem.svg``; each appears whole or not at all."""
    make_folder(stem.parent)
    figure.draw_without_rendering()
    # The layout is settled once, not for every format.
    figure.set_layout_engine("none")
    paths = [stem.with_name(f"{stem.name}.{kind}") for kind in ("png", "svg")]
    for path in paths:
        with atomic_path(path) as part:
            part.write_bytes(rendered(figure, path.suffix[1:]))
    return paths


def rendered(figure: Figure, kind: str, dots_per_inch: float = DOTS_PER_INCH) -> bytes:
    """Bytes of a figure as png, jpg or svg; the same for the same figure."""
    data = io.BytesIO()
    options: dict[str, Any] = {"pil_kwargs": {"quality": 72}} if kind == "jpg" else {}
    # No date and no random names: a report made again from the same study is the same file.
    metadata = {"Date": None} if kind == "svg" else None
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "speckle3d", "font.family": "sans-serif"}):
        figure.savefig(data, format=kind, dpi=dots_per_inch, metadata=metadata, **options)
    if kind != "svg":
        return data.getvalue()
    # A hundredth of a point is finer than any printer; six decimals are most of the file.
    return re.sub(rb"(\d\.\d\d)\d+", rb"\1", data.getvalue())


def _figure(
    width_in: float, height_in: float, layout: Literal["constrained", "compressed"] = "constrained"
) -> Figure:
    figure = Figure(figsize=(width_in, height_in), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def _outline(axes: Any, line: FloatArray, **style: Any) -> None:
    axes.plot(line[:, 2], line[:, 0], line[:, 1], **style)


def _draw_cut(above: Axes, below: Axes, cut: Cut) -> None:
    greys = colormaps["gray"].with_extremes(bad=_BLANK)
    width, height = cut.extent_mm
    above.imshow(cut.image, cmap=greys, vmin=0, vmax=255, extent=(0.0, width, height, 0.0),
                 interpolation="nearest")  # fmt: skip
    above.add_patch(
        Rectangle((cut.corner_mm[0], cut.corner_mm[1]), *cut.size_mm, fill=False, edgecolor="#ffd000")
    )
    left, top = cut.corner_mm
    below.imshow(cut.detail, cmap=greys, vmin=0, vmax=255, interpolation="nearest",
                 extent=(left, left + cut.size_mm[0], top + cut.size_mm[1], top))  # fmt: skip
    below.tick_params(labelsize="small")
    for spine in below.spines.values():
        spine.set(color="#ffd000", linewidth=2)


def _label(axes: Axes, x: str, y: str, grid: bool = True) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if grid:
        axes.grid(visible=True, alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
