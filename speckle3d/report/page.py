"""A study as one page to read, print and pass on: every figure and number, no network."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from markupsafe import Markup

from speckle3d.core.errors import Speckle3DError
from speckle3d.core.printable import printable
from speckle3d.io.hdf5 import atomic_path
from speckle3d.report import figures as draw
from speckle3d.report import tables
from speckle3d.report.data import Cuts, Record, StudyData, SweepView, cut_modes, load_view, read_study
from speckle3d.study.figures import curve_panels, figure_panels, name_figure
from speckle3d.study.folder import only_run
from speckle3d.study.overall import counted
from speckle3d.study.results import copy_lines

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from plotly.graph_objects import Figure as Plot

_FIGURE = re.compile(r"(?P<stem>.+-[0-9a-f]{8})-(curves|outlines|reslices|patches)\.(png|svg)")
"""Names of a sweep's figures: they begin with its folder's name, which ends in eight digits of its key."""


@dataclass(frozen=True)
class PageFigure:
    """A figure of the page: a picture for print, and what draws it where scripts run.

    Attributes
    ----------
    name : str
        Unique on the page.
    source : str
        The picture as a data URL.
    caption : str
        Also read aloud in place of the picture.
    plot : str
        Data and layout for plotly.js as JSON, "<" and "/" escaped; empty for a picture alone.
    width : int or None
        On paper, in CSS pixels; None to let the picture tell.
    """

    name: str
    source: str
    caption: str
    plot: Markup
    width: int | None = None


@dataclass(frozen=True)
class Section:
    """One sweep on the page; `broken` says why it cannot be shown, `quiet` what it does not hold."""

    anchor: str
    name: str
    notes: Sequence[str] = ()
    figures: Sequence[PageFigure] = ()
    broken: str = ""
    quiet: str = ""


def write_report(directory: Path) -> Path:
    """Write ``report.html`` and the folder ``figures`` from a study's ``study.json`` and its sweeps' folders.

    The page is one file that needs no network: with scripts its curves, outlines and maps can be turned and
    read off; without, and in print, it shows the same figures as pictures. A sweep that cannot be shown is
    listed with its reason, and does not stop the others. Figures of sweeps that are no longer in the study
    are removed.

    Parameters
    ----------
    directory : path
        The study's folder.

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
        overview = _overview(study, directory)
        sections = [_section(directory, entry, f"sweep-{i + 1}") for i, entry in enumerate(study.done)]
        stems = {str(entry.get("folder", "")).rpartition("/")[2] for entry in study.done}
        _clear_figures(directory / "figures", stems)
        target = directory / "report.html"
        with atomic_path(target) as part:
            part.write_text(_page(study, overview, sections), encoding="utf-8")
        return target


def _page(study: StudyData, overview: PageFigure | None, sections: Sequence[Section]) -> str:
    """Fill the template."""
    from plotly.offline import get_plotlyjs

    anchors = {each.name: each.anchor for each in sections}
    found = tables.scored_means(study.single, study.modes)
    lead = tables.summary_lines(found, len(study.done), len(study.broken), study.paired, study.references)
    keys = ("name", "path", "sha256", "key", "seconds")
    best = tables.clearly_best(found.means, study.paired) if found.together else None
    scripts = [get_plotlyjs(), files("speckle3d.report").joinpath("script.js").read_text(encoding="utf-8")]
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("speckle3d", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html").render(
        shown=counted(len(study.done) - len(study.copies) or len(study.broken), "sweep"),
        lead=lead + [f"{line}." for line in copy_lines(study.copies)],
        doubts=tables.records_table([_said(each) for each in study.doubts], anchors),
        broken=tables.records_table(study.broken, columns=("name", "status", "reason")),
        modes=tables.records_table(
            found.means, styles=["best" if row["mode"] == best else "" for row in found.means]
        ),
        overview=overview,
        parts=tables.parts_table(study.rows, anchors),
        drift=tables.records_table(study.drift, anchors),
        intervals=tables.intervals_table(study.intervals),
        paired=tables.paired_table(study.paired),
        sections=sections,
        figures=[*([overview] if overview else []), *(each for some in sections for each in some.figures)],
        configuration=study.settings_toml,
        version=version("speckle3d"),
        provenance=tables.records_table([*study.done, *study.broken], columns=keys),
        scripts=[Markup(text) for text in scripts],
        script_hashes=" ".join(_hash(text) for text in scripts),
    )


def _said(doubt: Record) -> dict[str, str]:
    """A doubt as a line of the page's table."""
    fate = "refused" if doubt.get("refuted") else "used"
    return {name: str(doubt[name]) for name in ("sweep", "about", "suspect", "evidence")} | {"it is": fate}


def _shown(value: Any) -> Any:
    """Escape characters that would change how a reader sees the text around; markup of our own is left."""
    return printable(value, kept="\n\t") if type(value) is str else value


def _clear_figures(folder: Path, stems: Collection[str]) -> None:
    """Remove figures, by the names given here, of sweeps or settings that are no longer in the study."""
    for path in folder.glob("*"):
        found = _FIGURE.fullmatch(path.name)
        if found and found["stem"] not in stems:
            path.unlink(missing_ok=True)


def _overview(study: StudyData, directory: Path) -> PageFigure | None:
    scored = [row for row in study.single if row.get("length_error_mm") is not None]
    if not scored:
        for path in (directory / "figures").glob("overview.*"):
            path.unlink()
        return None
    modes = [mode for mode in study.modes if any(row["mode"] == mode for row in scored)]
    panels = draw.overview_panels(scored, modes)
    caption = (
        "Errors of length and tilt: a point for every part of every sweep, a bar from minus to plus the mean "
        "magnitude over the mode's sweeps."
    )
    plot = draw.plot_panels({"": panels}, 2, 140 + 50 * len(modes))
    drawn = figure_panels(panels, 2, (9.0, 1.8 + 0.5 * len(modes)))
    name_figure(drawn, "a point: a part of a sweep; a bar: the mean magnitude over sweeps, either way")
    return _filed(directory, "overview", drawn, caption, plot)


def _section(directory: Path, entry: Record, anchor: str) -> Section:
    name = str(entry["name"])
    try:
        view = load_view(directory, entry)
        cuts = cut_modes(view)
        drawn = [each(directory, view, cuts) for each in (_curves, _outlines, _reslices, _patches)]
    except Speckle3DError as error:
        return Section(anchor, name, broken=str(error))
    quiet = "" if drawn[-1] else "The file of this sweep holds no patches."
    return Section(anchor, name, view.notes, [each for each in drawn if each is not None], quiet=quiet)


def _curves(directory: Path, view: SweepView, _cuts: Cuts | None) -> PageFigure:
    curves, frames = view.curves, draw.decimated(view.curves.frames)
    panels = curve_panels(curves, frames=frames)
    views = {"accumulated": panels}
    if curves.reference is not None:
        views[f"minus {curves.reference_name}"] = curve_panels(curves, frames=frames, minus_reference=True)
    caption = "Accumulated length of travel, tilt, yaw and roll."
    if curves.half_width is not None:
        caption += " The band is the 95 % interval of the uncorrected trajectory, from its covariance."
    drawn = figure_panels(panels, 2, (9.0, 6.0))
    plot = draw.plot_panels(views, 2, 620)
    return _filed(directory, f"{view.folder.name}-curves", drawn, caption, plot)


def _outlines(directory: Path, view: SweepView, _cuts: Cuts | None) -> PageFigure:
    laid = {mode: each[0].inv() * each for mode, each in view.poses.items()}
    series = draw.outline_series(laid, view.reconstruction.grid)
    caption = (
        f"Outlines of {draw.OUTLINES} frames of every mode in space, first frames laid on each other"
        f"{'; in print the reference is grey' if view.curves.reference_name in view.poses else ''}."
    )
    drawn, plot = draw.figure_outlines(series), draw.plot_outlines(series)
    return _filed(directory, f"{view.folder.name}-outlines", drawn, caption, plot)


def _reslices(directory: Path, view: SweepView, cuts: Cuts | None) -> PageFigure | None:
    if cuts is None:
        return None
    caption = (
        "The sweep cut along its travel at the middle vector, at the poses of every mode, and the same place "
        f"of the same frame enlarged ({cuts.depth_mm:.0f} mm deep). Blue: no frame reached."
    )
    return _filed(directory, f"{view.folder.name}-reslices", draw.figure_cuts(cuts), caption, dpi=110)


def _patches(directory: Path, view: SweepView, cuts: Cuts | None) -> PageFigure | None:
    if view.rejected is None or not np.isfinite(view.rejected.share).any():
        return None
    sensed = view.details.get("details", {}).get("rejected_patch_share") is not None
    caption = (
        "Patches left out because the sensed orientation contradicts their distances"
        if sensed
        else "Patches that took no part in the plane of their pair of frames"
    )
    caption += ": where in the image, in how many of the pairs, and how many over the sweep."
    drawn = draw.figure_rejected(view.rejected, cuts, view.reconstruction.grid)
    plot = draw.plot_rejected(view.rejected)
    return _filed(directory, f"{view.folder.name}-patches", drawn, caption, plot, 90)


def _filed(
    directory: Path, name: str, drawn: Figure, caption: str, plot: Plot | None = None, dpi: int | None = None
) -> PageFigure:
    """File a figure and put it on the page as a vector picture, or as JPEG of `dpi` dots per inch.

    A vector picture of a figure with an image in it would be large.
    """
    kind, width, picture = "svg+xml", None, draw.save_both(drawn, directory / "figures" / name)
    if dpi is not None:
        kind, width = "jpeg", round(96 * drawn.get_size_inches()[0])
        picture = draw.rendered(drawn, "jpg", dpi)
    source = f"data:image/{kind};base64,{base64.b64encode(picture).decode('ascii')}"
    return PageFigure(f"plot-{name}", source, caption, Markup("" if plot is None else plot.to_json()), width)


def _hash(text: str) -> str:
    digest = base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
    return f"'sha256-{digest}'"
