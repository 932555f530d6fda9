"""A study as one page to read, print and pass on: every figure and number, no network."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.errors import Speckle3DError
from speckle3d.io.hdf5 import atomic_path
from speckle3d.report import figures as draw
from speckle3d.report import plots as interactive
from speckle3d.report.data import SweepView, load_view, read_study
from speckle3d.report.html import (
    Figure,
    modes_table,
    page,
    paragraphs,
    parts_table,
    records_table,
)
from speckle3d.report.reslices import Cuts, cut_modes
from speckle3d.report.statistics import (
    best_of,
    counted,
    intervals_table,
    paired_table,
    scored_means,
    summary_lines,
)
from speckle3d.study.lock import only_run
from speckle3d.study.results import copy_lines

_FIGURE = re.compile(r"(?P<stem>.+-[0-9a-f]{8})-(curves|outlines|reslices|patches)\.(png|svg)")
"""What a sweep's figures are called: its folder's name, which ends in eight digits of its key, first."""

_NOTHING = '<p class="quiet">There is nothing to compare.</p>'

_TABLES = {
    "drift": (
        "Drift",
        "The final (FDR) and average drift rate (ADR) are shares of the true path's length. Maximum (MD) and "
        "sum of drift (SD), Hausdorff distance (HD), and the mean shift of the image's points against the "
        "first frame (global: GPE, GLE) and the frame before (local: LPE, LLE) are in millimetres, the mean "
        "error of angle (EA) in degrees.",
    ),
    "intervals": (
        "Means over sweeps",
        "One number per sweep: of the errors of its parts, the mean magnitude. In brackets the 95 % interval "
        "over sweeps, by bootstrap. Where modes are of different numbers of sweeps, they do not compare side "
        "by side, but in pairs.",
    ),
    "paired": (
        "Modes compared in pairs",
        "Mean difference on the same sweeps and its 95 % interval. Bold where the modes are told apart: the "
        "interval leaves out zero, and a signed-rank test corrected for the number of pairs (Holm) agrees at "
        "0.05, which takes six sweeps for two modes and eight for four.",
    ),
}

_WRITERS = {"intervals": intervals_table, "paired": paired_table}


def write_report(directory: Path, progress: Callable[[int, int], None] | None = None) -> Path:
    """Write ``report.html`` and the folder ``figures`` from a study's ``study.json`` and its sweeps' folders.

    The page is one file that needs no network: with scripts its curves, outlines and maps can be turned and
    read off; without, and in print, it shows the same figures as pictures. A sweep that cannot be shown is
    told with its reason, and does not stop the others. Figures of sweeps that are no longer in the study go.

    Parameters
    ----------
    directory : path
        The study's folder.
    progress : callable, optional
        Called with the number of sweeps done and of all.

    Returns
    -------
    Path
        Of the page, which appears whole or not at all.

    Raises
    ------
    InvalidInputError
        If there is no study in the folder.
    FileError
        If the page cannot be written, or another run is at work in the folder.
    """
    study = read_study(directory)
    with only_run(directory):
        return _write(directory, study, progress)


def _write(directory: Path, study: Mapping[str, Any], progress: Callable[[int, int], None] | None) -> Path:
    rows = [row for row in study.get("rows", []) if isinstance(row, dict)]
    modes = list(dict.fromkeys([*study.get("modes", []), *(row["mode"] for row in rows)]))
    done = [entry for entry in study["sweeps"] if entry.get("status") == "done"]
    broken = [entry for entry in study["sweeps"] if entry.get("status") != "done"]
    anchors = {entry["name"]: f"sweep-{i + 1}" for i, entry in enumerate(done)}
    copies = {entry["name"]: entry["copy_of"] for entry in done if entry.get("copy_of")}
    single = [row for row in rows if row["sweep"] not in copies]
    scored = [row for row in single if row.get("length_error_mm") is not None]
    found = scored_means(single, modes)
    references = {row["sweep"]: row["reference"] for row in single if row.get("reference")}
    figures: list[Figure] = []
    overview = _overview(directory, scored, modes, figures)
    sections = []
    for i, entry in enumerate(done):
        sections.append(_section(directory, entry, f"sweep-{i + 1}", figures))
        if progress:
            progress(i + 1, len(done))
    shown = counted(len(done) - len(copies) or len(broken), "sweep")
    parts = {
        "title": f"Drift-correction modes compared on {shown}",
        "lead": paragraphs(
            summary_lines(found, len(done), len(broken), study.get("paired") or [], references)
            + [f"{line}." for line in copy_lines(copies)]
        ),
        "broken": _broken(broken),
        "modes": modes_table(found.means, best_of(found.means, "length_percent") if found.together else None)
        + overview
        or _NOTHING,
        "parts": parts_table(rows, anchors),
        "tables": _tables(study, anchors),
        "buttons": _buttons(done),
        "sweeps": "\n".join(sections) or _NOTHING,
        "configuration": escape(str(study.get("settings_toml", ""))),
        "provenance": _provenance(study),
    }
    _clear_figures(directory / "figures", {str(entry.get("folder", "")).rpartition("/")[2] for entry in done})
    target = directory / "report.html"
    with atomic_path(target) as part:
        part.write_text(page(parts, figures), encoding="utf-8")
    return target


def _clear_figures(folder: Path, stems: Collection[str]) -> None:
    """Remove figures, by the names given here, of sweeps or settings that are no longer in the study."""
    for path in folder.glob("*"):
        found = _FIGURE.fullmatch(path.name)
        if found and found["stem"] not in stems:
            path.unlink(missing_ok=True)


def _overview(
    directory: Path, scored: Sequence[Mapping[str, Any]], modes: Sequence[str], figures: list[Figure]
) -> str:
    if not scored:
        for path in (directory / "figures").glob("overview.*"):
            path.unlink()
        return ""
    shown = [mode for mode in modes if any(row["mode"] == mode for row in scored)]
    caption = (
        "Errors of length and tilt: a point for every part of every sweep, a bar from minus to plus the mean "
        "magnitude over the mode's sweeps."
    )
    plot = interactive.plot_overview(scored, shown)
    return _vector(directory, "overview", draw.figure_overview(scored, shown), caption, figures, plot)


def _section(directory: Path, entry: Mapping[str, Any], anchor: str, figures: list[Figure]) -> str:
    title = f"<h3>{escape(str(entry['name']))}</h3>"
    try:
        view = load_view(directory, entry)
        content = _sweep(directory, view, anchor, figures)
    except Speckle3DError as error:
        content = paragraphs([f"This sweep's results cannot be shown: {error}"], "note")
    return f'<section class="sweep" id="{anchor}" role="tabpanel">{title}{content}</section>'


def _sweep(directory: Path, view: SweepView, anchor: str, figures: list[Figure]) -> str:
    cuts = cut_modes(view)
    stem = view.folder.name
    grid = view.reconstruction.grid
    pieces = [paragraphs(view.notes, "note")]
    pieces.append(
        _vector(directory, f"{stem}-curves", draw.figure_curves(view.curves), _curves_caption(view), figures,
                interactive.plot_curves(view.curves))
    )  # fmt: skip
    caption = (
        f"Outlines of {draw.OUTLINES} frames of every mode in space, first frames laid on each other"
        f"{'; in print the reference is grey' if view.curves.reference_name in view.poses else ''}."
    )
    outlines = draw.figure_outlines(view.poses, grid, view.curves.reference_name)
    plot = interactive.plot_outlines(view.poses, grid)
    pieces.append(_vector(directory, f"{stem}-outlines", outlines, caption, figures, plot))
    if cuts is not None:
        pieces.append(_reslices(directory, f"{stem}-reslices", cuts, figures))
    pieces.append(_patches(directory, f"{stem}-patches", view, cuts, figures))
    return "".join(pieces)


def _curves_caption(view: SweepView) -> str:
    caption = "Accumulated length of travel, tilt, yaw and roll."
    if view.curves.half_width is not None:
        caption += " The band is the 95 % interval of the uncorrected trajectory, from its covariance."
    return caption


def _reslices(directory: Path, name: str, cuts: Cuts, figures: list[Figure]) -> str:
    drawn = draw.figure_cuts(cuts)
    draw.save_both(drawn, directory / "figures" / name)
    width_in = drawn.get_size_inches()[0]
    caption = (
        "The sweep cut along its travel at the middle vector, at the poses of every mode, and the same place "
        f"of the same frame enlarged ({cuts.depth_mm:.0f} mm deep). Blue: no frame reached."
    )
    figure = Figure(
        f"plot-{name}", draw.rendered(drawn, "jpg", 110), "image/jpeg", caption, width_in=width_in
    )
    figures.append(figure)
    return figure.html()


def _patches(directory: Path, name: str, view: SweepView, cuts: Cuts | None, figures: list[Figure]) -> str:
    if view.rejected is None or not np.isfinite(view.rejected.share).any():
        return paragraphs(["The file of this sweep holds no patches."], "quiet")
    sensed = view.details.get("details", {}).get("rejected_patch_share") is not None
    caption = (
        "Patches left out because the sensed orientation contradicts their distances"
        if sensed
        else "Patches that took no part in the plane of their pair of frames"
    )
    caption += ": where in the image, in how many of the pairs, and how many over the sweep."
    drawn = draw.figure_rejected(view.rejected, cuts, view.reconstruction.grid)
    draw.save_both(drawn, directory / "figures" / name)
    # The image beneath would make a vector picture large.
    picture = draw.rendered(drawn, "jpg", 90)
    plot = interactive.plot_rejected(view.rejected)
    figures.append(Figure(f"plot-{name}", picture, "image/jpeg", caption, plot, drawn.get_size_inches()[0]))
    return figures[-1].html()


def _vector(
    directory: Path, name: str, drawn: Any, caption: str, figures: list[Figure], plot: dict[str, Any]
) -> str:
    """File a figure and put it on the page as a vector picture, with its interactive twin."""
    _, vector = draw.save_both(drawn, directory / "figures" / name)
    figures.append(Figure(f"plot-{name}", vector.read_bytes(), "image/svg+xml", caption, plot))
    return figures[-1].html()


def _broken(entries: Sequence[Mapping[str, Any]]) -> str:
    if not entries:
        return ""
    records = [{key: entry.get(key) for key in ("name", "status", "reason")} for entry in entries]
    return f'<h2 id="broken">Sweeps without a result</h2><div class="broken">{records_table(records)}</div>'


def _tables(study: Mapping[str, Any], anchors: Mapping[str, str]) -> str:
    shown = []
    for key, (title, words) in _TABLES.items():
        records = study.get(key) or []
        if records:
            write = _WRITERS.get(key)
            table = write(records) if write else records_table(records, anchors)
            shown.append(f'<h2 id="{key}">{title}</h2><p class="quiet">{words}</p>{table}')
    return "".join(shown)


def _buttons(done: Sequence[Mapping[str, Any]]) -> str:
    return "".join(
        f'<button role="tab" type="button" data-sweep="sweep-{i + 1}" aria-controls="sweep-{i + 1}" '
        f'aria-selected="false">{escape(str(entry["name"]))}</button>'
        for i, entry in enumerate(done)
    )


def _provenance(study: Mapping[str, Any]) -> str:
    from importlib.metadata import version

    keys = ("name", "path", "sha256", "key", "seconds")
    records = [{key: entry.get(key) for key in keys} for entry in study["sweeps"]]
    made = f"Report made by speckle3d {version('speckle3d')}."
    return paragraphs([made], "quiet") + records_table(records)
