"""Tables of text for a terminal or a file, laid out by rich."""

from __future__ import annotations

import io
from collections.abc import Collection, Sequence

from speckle3d.core.printable import printable


def text_table(lines: Sequence[Sequence[str]], left: Collection[int] = (0,), heading: bool = True) -> str:
    """Align columns of text.

    Parameters
    ----------
    lines : sequence of sequence of str
        Cells, shown escaped (`printable`); the first line is the heading, if there is one.
    left : collection of int
        Columns aligned to the left; the others to the right.
    heading : bool
        Rule off the first line.

    Returns
    -------
    str
        Lines without trailing blanks, each ending in a newline.
    """
    from rich.cells import cell_len
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    if not lines:
        return ""
    body = [[printable(cell) for cell in line] for line in lines]
    widths = [max(cell_len(cell) for cell in column) for column in zip(*body, strict=True)]
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    for k, width in enumerate(widths):
        table.add_column(justify="left" if k in left else "right", width=width, no_wrap=True)
    if heading:
        body.insert(1, ["-" * width for width in widths])
    for line in body:
        table.add_row(*(Text(cell) for cell in line))
    out = io.StringIO()
    Console(file=out, width=sum(widths) + 2 * len(widths) + 1, color_system=None).print(table)
    return "".join(f"{line.rstrip()}\n" for line in out.getvalue().splitlines())


def text_rows(rows: Sequence[tuple[str, str, str]]) -> str:
    """Align rows of description, value and unit, as commands print them."""
    return text_table(
        [(description, f"{value} {unit}".rstrip()) for description, value, unit in rows], {0, 1}, False
    )
