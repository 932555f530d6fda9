"""The code on pages for users: what is run, what is only parsed, and how."""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]

_FENCE = re.compile(r"^```(\w+)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)

_TIMEOUT_S = 1800
_OMISSIONS = ("pip ", "python -m pytest")


def blocks(page):
    """Language and text of all fenced blocks of a page in order."""
    return _FENCE.findall(page.read_text())


def shown_commands(page):
    """Command lines behind a `$` in blocks that are shown, continued lines joined."""
    console = "".join(text for language, text in blocks(page) if language == "console")
    return [line[2:] for line in console.replace("\\\n", " ").splitlines() if line.startswith("$ ")]


def run_page(page, folder):
    """Run a page's sh and python blocks in order, in a folder with `data` alone; return what they print.

    Installing is left out, as the tests run installed; so is the command that runs the tests.
    """
    return "".join(output for language, _, output in ran(page, folder) if language in ("sh", "python"))


def ran(page, folder):
    """Language and text of each block of a page, and what it printed when it was run as `run_page` does."""
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
    python: list[str] = []
    for language, text in blocks(page):
        if language == "sh":
            arguments = ["bash", "-euo", "pipefail", "-c", _without_installing(text)]
        elif language == "python":
            # Blocks of a page share their names; those before are run again, without what they print.
            script.write_text(_after(python, text))
            python.append(text)
            arguments = [sys.executable, "-W", "error::DeprecationWarning:__main__", str(script)]
        else:
            yield language, text, ""
            continue
        process = subprocess.run(
            arguments, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, timeout=_TIMEOUT_S,
        )  # fmt: skip
        assert process.returncode == 0, f"{page.name}:\n{text}\n{process.stdout}"
        yield language, text, process.stdout


def _after(before, text):
    if not before:
        return text
    quiet = "\n".join(before)
    return (
        f"import contextlib, io\nwith contextlib.redirect_stdout(io.StringIO()):\n    exec({quiet!r})\n{text}"
    )


def _without_installing(text):
    lines = []
    for line in text.splitlines():
        parts = [part for part in line.split(" && ") if not part.lstrip().startswith(_OMISSIONS)]
        lines.append(" && ".join(parts))
    return "\n".join(lines)


def run_tutorial(name, tmp_path):
    """Run a tutorial in an empty folder; return the folder and what it printed."""
    folder = tmp_path / "empty"
    folder.mkdir()
    return folder, run_page(ROOT / "docs" / "tutorials" / name, folder)
