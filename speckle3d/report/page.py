"""A study as one page to read, print and pass on: every figure and number, no network."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from markupsafe import Markup

from speckle3d.core.errors import Speckle3DError
from speckle3d.core.text import printable
from speckle3d.io.hdf5 import atomic_path
from speckle3d.report import figures as draw
from speckle3d.report import tables
from speckle3d.report.data import SweepView, load_view
from speckle3d.scoring.displacements import MEANINGS
from speckle3d.study.figures import save_figure
from speckle3d.study.overall import Row, means_table
from speckle3d.study.results import Study, SweepOutcome

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as Plot

_PICTURES = {
    "reslice.png": "The sweep cut along its travel at the middle vector, at the poses of every mode. "
    "Blue-grey: no frame reached.",
    "enlarged.png": "Part of that cut, enlarged.",
}


@dataclass(frozen=True)
class PageFigure:
    """A figure of the page.

    Attributes
    ----------
    caption : str
        Also read aloud.
    name : str
        Of a plot, unique on the page.
    plot : str
        Data and layout for plotly.js as JSON, "<" and "/" escaped; empty for a picture.
    source : str
        The picture as a data URL; empty for a plot.
    """

    caption: str
    name: str = ""
    plot: str = ""
    source: str = ""


@dataclass(frozen=True)
class Section:
    """One sweep on the page; `failure` says why it cannot be shown."""

    anchor: str
    name: str
    notes: Sequence[str] = ()
    figures: Sequence[PageFigure] = ()
    failure: str = ""


def write_report(study: Study) -> Path:
    """Write a study's ``report.html``, from its results and its sweeps' folders, and ``overview.png``.

    The page is one file that needs no network, and appears whole or not at all. A sweep that cannot be shown
    is listed with its reason, and does not stop the others.

    Raises
    ------
    FileError
        If the page cannot be written.
    """
    overview = _overview(study)
    sections = [
        _section(study.directory, outcome, f"sweep-{i + 1}") for i, outcome in enumerate(study.successes)
    ]
    target = study.directory / "report.html"
    with atomic_path(target) as part:
        part.write_text(_page(study, overview, sections), encoding="utf-8")
    return target


def _page(study: Study, overview: PageFigure | None, sections: Sequence[Section]) -> str:
    """Fill the template."""
    from plotly.offline import get_plotlyjs

    anchors = {section.name: section.anchor for section in sections}
    scripts = [get_plotlyjs(), files("speckle3d.report").joinpath("script.js").read_text(encoding="utf-8")]
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("speckle3d", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_escape,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    plots = [overview, *(figure for section in sections for figure in section.figures)]
    keys, (intervals, comparisons) = ("name", "path", "sha256", "key", "seconds"), study.statistics
    drifts = {key for row in study.drift for key, value in row.items() if value is not None}
    return environment.get_template("page.html").render(
        sweep_count=tables.sweeps_text(len(study.successes) or len(study.failures)),
        lead=tables.summary_lines(study),
        doubts=tables.records_table([_doubt_row(doubt) for doubt in study.doubts], (), anchors),
        failures=tables.records_table(
            [outcome.record() for outcome in study.failures], ("name", "status", "reason")
        ),
        overview=overview,
        parts=tables.parts_table(study.rows, anchors),
        drift=tables.records_table(study.drift, (), anchors),
        meanings={key.partition("_")[0]: words for key, words in MEANINGS.items() if key in drifts},
        intervals=means_table(intervals) if intervals else [],
        comparisons=tables.pairs(comparisons),
        sections=sections,
        plots=[figure for figure in plots if figure is not None and figure.plot],
        configuration=study.settings_toml,
        version=version("speckle3d"),
        provenance=tables.records_table([outcome.record() for outcome in study.outcomes], keys),
        scripts=[Markup(text) for text in scripts],
        script_hashes=" ".join(_hash(text) for text in scripts),
    )


def _doubt_row(doubt: Row) -> dict[str, str]:
    """A doubt as a line of the page's table."""
    fate = "refused" if doubt.get("refuted") else "used"
    return {name: str(doubt[name]) for name in ("sweep", "about", "suspect", "evidence")} | {"it is": fate}


def _escape(value: Any) -> Any:
    """Escape characters that would change how a reader sees the text around; markup of our own is left."""
    return printable(value, kept="\n\t") if type(value) is str else value


def _overview(study: Study) -> PageFigure | None:
    rows = tables.rows_with_error(study)
    if not rows:
        return None
    modes = list(dict.fromkeys(row["mode"] for row in rows))
    caption = "a point: a part of a sweep; a bar: the mean magnitude of all, either way"
    path = save_figure(draw.draw_overview(rows, modes, caption), study.directory / "overview.png")
    return _picture(path, f"Errors: {caption}.")


def _section(directory: Path, outcome: SweepOutcome, anchor: str) -> Section:
    try:
        view = load_view(directory, outcome)
        pictures = [_picture(view.folder / file, caption) for file, caption in _PICTURES.items()]
    except (Speckle3DError, OSError) as error:
        return Section(anchor, outcome.name, failure=str(error))
    return Section(anchor, outcome.name, view.notes, [*_plots(view, anchor), *pictures])


def _plots(view: SweepView, anchor: str) -> list[PageFigure]:
    caption = "Accumulated length of travel, tilt, yaw and roll; the band is the 95 % interval of mode image."
    plots = [_plot_figure(f"{anchor}-curves", draw.plot_curves(view.curves), caption)]
    caption = f"Outlines of {draw.OUTLINES} frames of every mode in space, first frames laid on each other."
    outlines = draw.plot_outlines(view.poses, view.reconstruction.grid)
    plots.append(_plot_figure(f"{anchor}-outlines", outlines, caption))
    pairs = view.reconstruction.pairs
    if pairs is not None and np.isfinite(pairs.distance_mm).any():
        caption = (
            "Patches left out of the plane of their pair of frames, because the sensed orientation or the "
            "other patches contradict them: where in the image, in how many of the pairs, and how many over "
            "the sweep."
        )
        plots.append(
            _plot_figure(f"{anchor}-patches", draw.plot_rejections(pairs, view.curves.frames), caption)
        )
    return plots


def _plot_figure(name: str, plot: Plot, caption: str) -> PageFigure:
    return PageFigure(caption, f"plot-{name}", Markup(plot.to_json()))


def _picture(path: Path, caption: str) -> PageFigure:
    source = base64.b64encode(path.read_bytes()).decode("ascii")
    return PageFigure(caption, source=f"data:image/png;base64,{source}")


def _hash(text: str) -> str:
    digest = base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
    return f"'sha256-{digest}'"
