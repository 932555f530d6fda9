"""The report's page: tables and figures as HTML, and the frame around them."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from speckle3d.report.figures import colour_of, label_of

_UNITS = {
    "_percent": " / %",
    "_mm": " / mm",
    "_deg": " / °",
    "_s": " / s",
}
_WORDS = (
    "sweep",
    "part",
    "mode",
    "reference",
    "remark",
    "name",
    "reason",
    "path",
    "sha256",
    "key",
    "status",
    "package",
    "reference",
)
_LONG = ("reason", "path", "sha256", "key", "file")
_ERRORS = ("length_error_mm", "length_error_percent", "tilt_error_deg", "yaw_error_deg", "roll_error_deg")

_PART_COLUMNS = ("sweep", "part", "mode", "reference", "frames", "reference_mm", "estimate_mm", *_ERRORS)


@dataclass(frozen=True)
class Figure:
    """A figure of the page: a picture for print, and what draws it where scripts run.

    Attributes
    ----------
    name : str
        Unique on the page.
    picture : bytes
    kind : str
        Media type of the picture.
    caption : str
        Also read aloud in place of the picture.
    plot : dict, optional
        Data and layout for plotly.js.
    width_in : float, optional
        On paper; by default what the picture says.
    """

    name: str
    picture: bytes
    kind: str
    caption: str
    plot: dict[str, Any] | None = None
    width_in: float | None = None

    def html(self) -> str:
        """Picture and caption."""
        data = base64.b64encode(self.picture).decode("ascii")
        plot = f' data-plot="{self.name}"' if self.plot else ""
        place = '<div class="plot"></div>' if self.plot else ""
        width = f' width="{self.width_in * 96:.0f}"' if self.width_in else ""
        words = escape(self.caption)
        return (
            f'<figure{plot}>{place}<img{width} alt="{words}" src="data:{self.kind};base64,{data}">'
            f"<figcaption>{words}</figcaption></figure>"
        )

    def data_html(self) -> str:
        """Block of data that the page's script draws from; empty for a picture alone."""
        if self.plot is None:
            return ""
        # "</" inside a script element would end it.
        text = json.dumps(self.plot, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
        return f'<script type="application/json" id="{self.name}">{text}</script>'


def page(parts: Mapping[str, str], figures: Sequence[Figure]) -> str:
    """Fill the template; `parts` are its HTML pieces by name."""
    from plotly.offline import get_plotlyjs

    folder = files("speckle3d.study")
    script = folder.joinpath("report_script.js").read_text(encoding="utf-8")
    plotly = get_plotlyjs()
    template = Template(folder.joinpath("report_template.html").read_text(encoding="utf-8"))
    return template.substitute(
        parts,
        plotly=plotly,
        script=script,
        script_hashes=" ".join(_hash(text) for text in (plotly, script)),
        plots="\n".join(figure.data_html() for figure in figures),
    )


def parts_table(rows: Sequence[Mapping[str, Any]], anchors: Mapping[str, str]) -> str:
    """Errors of every sweep, part and mode; sweeps lead to their figures."""
    if not rows:
        return '<p class="quiet">No sweep was compared.</p>'
    lines = []
    before = None
    columns = [*_PART_COLUMNS, *(["remark"] if any(row.get("remark") for row in rows) else [])]
    for row in rows:
        here = (row.get("sweep"), row.get("part"))
        cells = "".join(_cell(key, row.get(key), anchors, signed=key in _ERRORS) for key in columns)
        lines.append(f'<tr class="{"first" if here != before else ""}">{cells}</tr>')
        before = here
    return _table(columns, lines)


def modes_table(means: Sequence[Mapping[str, Any]], best: str | None) -> str:
    """Mean magnitudes of the errors by mode; the best in length in bold."""
    if not means:
        return ""
    lines = []
    for row in means:
        cells = "".join(_cell(key, value, {}) for key, value in row.items())
        lines.append(f'<tr class="{"best" if row["mode"] == best else ""}">{cells}</tr>')
    return _table(list(means[0]), lines)


def records_table(records: Sequence[Mapping[str, Any]], anchors: Mapping[str, str] | None = None) -> str:
    """Any list of records as a table, columns in the order they first appear."""
    keys = list(dict.fromkeys(key for record in records for key in record))
    lines = [
        "<tr>" + "".join(_cell(key, record.get(key), anchors or {}) for key in keys) + "</tr>"
        for record in records
    ]
    return _table(keys, lines, {key for record in records for key, v in record.items() if isinstance(v, str)})


def plain_table(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Words by line as a table, the first column's to the left; cells are HTML already."""
    rows = [
        "<tr>"
        + "".join(f'<td class="{"" if i else "word"}">{cell}</td>' for i, cell in enumerate(line))
        + "</tr>"
        for line in lines
    ]
    return _table([escape(head) for head in heads], rows, [escape(heads[0])]) if lines else ""


def paragraphs(lines: Sequence[str], style: str = "") -> str:
    """Lines of plain text as paragraphs."""
    return "".join(
        f'<p class="{style}">{escape(line)}</p>' if style else f"<p>{escape(line)}</p>" for line in lines
    )


def heading_of(key: str) -> str:
    """Words and unit from a column's name: ``length_error_mm`` is "length error / mm"."""
    for ending, unit in _UNITS.items():
        if key.endswith(ending):
            return key.removesuffix(ending).replace("_", " ") + unit
    return key.replace("_", " ")


def _table(keys: Sequence[str], lines: Sequence[str], words: Collection[str] = ()) -> str:
    heads = "".join(
        f'<th class="{_style(key, key if key in words else 0.0)}">{escape(heading_of(key))}</th>'
        for key in keys
    )
    body = "".join(lines)
    return f'<div class="wide"><table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>'


def _cell(key: str, value: Any, anchors: Mapping[str, str], signed: bool = False) -> str:
    text = escape(_shown(key, value, signed))
    if key in ("mode", "other", "against", "better") and isinstance(value, str):
        text = f'<span class="swatch" style="background:{colour_of(value)}"></span>{escape(label_of(value))}'
    if key == "sweep" and value in anchors:
        text = f'<a href="#{anchors[value]}">{text}</a>'
    return f'<td class="{_style(key, value)}">{text}</td>'


def _style(key: str, value: Any = 0.0) -> str:
    return ("word" if key in _WORDS or isinstance(value, str) else "") + (" long" if key in _LONG else "")


def _shown(key: str, value: Any, signed: bool) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:{'+' if signed else ''}.{_digits(key)}f}"
    if isinstance(value, list):
        return ", ".join(_shown(key, one, signed) for one in value)
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(key, one, signed)}" for name, one in value.items())
    return str(value)


def _digits(key: str) -> int:
    if key.startswith(("LPE", "LLE")):
        # From one frame to the next: hundredths of a millimetre are already large.
        return 4
    return 1 if key.endswith(("percent", "_s")) else 2 if key.endswith(("_mm", "_deg")) else 3


def _hash(text: str) -> str:
    digest = base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
    return f"'sha256-{digest}'"
