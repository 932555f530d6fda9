"""The code on pages for users: what is run, what is only parsed, and how."""

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]

_FENCE = re.compile(r"^```(\w+)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)

_TIMEOUT_S = 1800
_LEFT_OUT = ("pip ", "python -m pytest")


@dataclass(frozen=True)
class Block:
    """One fenced block of a page: its language, its text, and the line it begins at."""

    language: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page in order."""
    text = page.read_text()
    return [Block(m[1], m[2], text.count("\n", 0, m.start()) + 1) for m in _FENCE.finditer(text)]


def shown_commands(page: Path) -> list[str]:
    """Command lines behind a `$` in blocks that are shown, continued lines joined."""
    found = []
    for block in blocks(page):
        if block.language == "console":
            joined = block.text.replace("\\\n", " ")
            found += [line[2:] for line in joined.splitlines() if line.startswith("$ ")]
    return found


def run_page(page: Path, folder: Path) -> str:
    """Run a page's sh and python blocks in order, in a folder with `data` alone; return what they print.

    Installing is left out, as the tests run installed; so is the command that runs the tests.
    """
    (folder / "data").symlink_to(ROOT / "data")
    command = folder.parent / f"{folder.name}-bin"
    command.mkdir()
    shim = command / "speckle3d"
    shim.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m speckle3d.cli "$@"\n')
    shim.chmod(0o755)
    environment = {
        **os.environ,
        "PATH": f"{command}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "MPLBACKEND": "Agg",
    }
    script = command / "page.py"
    printed = ""
    python: list[str] = []
    for block in blocks(page):
        if block.language == "sh":
            runs = _without_installing(block.text)
            arguments = ["bash", "-euo", "pipefail", "-c", runs]
        elif block.language == "python":
            # Blocks of a page share their names; those before are run again, without what they print.
            script.write_text(_after(python, block.text))
            python.append(block.text)
            arguments = [sys.executable, "-W", "error::DeprecationWarning:__main__", str(script)]
        else:
            continue
        done = subprocess.run(
            arguments, cwd=folder, env=environment, capture_output=True, text=True, timeout=_TIMEOUT_S
        )
        where = f"{page.name}, line {block.line}"
        assert done.returncode == 0, f"{where}:\n{block.text}\n{done.stdout}{done.stderr}"
        printed += done.stdout
    return printed


def _after(before: list[str], text: str) -> str:
    if not before:
        return text
    quiet = "\n".join(before)
    return (
        f"import contextlib, io\nwith contextlib.redirect_stdout(io.StringIO()):\n    exec({quiet!r})\n{text}"
    )


def _without_installing(text: str) -> str:
    kept = []
    for line in text.splitlines():
        parts = [part for part in line.split(" && ") if not part.lstrip().startswith(_LEFT_OUT)]
        kept.append(" && ".join(parts))
    return "\n".join(kept)


def run_tutorial(name: str, tmp_path: Path) -> tuple[Path, str]:
    """Run a tutorial in an empty folder; return the folder and what it printed."""
    folder = tmp_path / "empty"
    folder.mkdir()
    return folder, run_page(ROOT / "docs" / "tutorials" / name, folder)
