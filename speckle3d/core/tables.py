"""Tables of text for a terminal or a file, aligned by the width of their characters."""

from __future__ import annotations

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

    if not lines:
        return ""
    body = [[printable(cell) for cell in line] for line in lines]
    widths = [max(map(cell_len, column)) for column in zip(*body, strict=True)]
    if heading:
        body.insert(1, ["-" * width for width in widths])
    text = ""
    for line in body:
        cells = []
        for column, (cell, width) in enumerate(zip(line, widths, strict=True)):
            pad = " " * (width - cell_len(cell))
            cells.append(cell + pad if column in left else pad + cell)
        text += "  ".join(cells).rstrip() + "\n"
    return text


def text_rows(rows: Sequence[tuple[str, str, str]]) -> str:
    """Align rows of description, value and unit, as commands print them."""
    return text_table(
        [(description, f"{value} {unit}".rstrip()) for description, value, unit in rows], {0, 1}, False
    )
