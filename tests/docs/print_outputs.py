"""Write what tutorials print into their pages: ``python tests/docs/print_outputs.py [PAGE...]``.

A block of text is what the block of commands before it prints; a line of three dots in it stays: it leaves
out what lies between as many first and last lines as there were.
"""

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from pages import ROOT, ran

WIDTH = 160
"""Letters of a line that are shown."""


def shorten(output, text):
    """What was printed, cut where the page cuts it."""
    lines, before = output.splitlines(), text.splitlines()
    if "..." in before:
        first = before.index("...")
        last = len(before) - first - 1
        lines = [*lines[:first], "...", *(lines[-last:] if last else [])]
    return "".join(f"{line[:WIDTH]}...\n" if len(line) > WIDTH else f"{line.rstrip()}\n" for line in lines)


def write_outputs(page):
    """Run a page, and put what it prints in place of what it shows."""
    text, last = page.read_text(encoding="utf-8"), None
    with tempfile.TemporaryDirectory() as folder:
        empty = Path(folder) / "empty"
        empty.mkdir()
        for language, block, output in ran(page, empty):
            if language == "text" and last is not None:
                text = text.replace(f"```text\n{block}```", f"```text\n{shorten(last, block)}```", 1)
            # What is only shown, as a console's lines, has not been run.
            last = output if language in ("sh", "python") else None
    page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    pages = sys.argv[1:] or sorted(map(str, (ROOT / "docs" / "tutorials").glob("*.md")))
    for name in pages:
        write_outputs(Path(name))
