"""Pages for users: their commands exist, their links lead somewhere, the README is a page."""

import re
import shlex
import tomllib

import pytest
from pages import ROOT, shown_commands

from speckle3d.cli import app

PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "data" / "README.md",
    *sorted((ROOT / "docs").glob("**/*.md")),
]
PAGES = [page for page in PAGES if "generated" not in page.parts]
TASKS = tomllib.loads((ROOT / "docs" / "reference" / "api.toml").read_text())
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]

_LINK = re.compile(r"\]\(([^)\s]+)\)")
_CODE = re.compile(r"^```.*?^```$|`[^`\n]*`", re.MULTILINE | re.DOTALL)
_ANY_ANGLE = re.compile(r"#.*$")


def commands_of(line):
    """The speckle3d command lines in a line of a shell."""
    for part in re.split(r"&&|\|(?!\|)|;", _ANY_ANGLE.sub("", line)):
        words = shlex.split(part)
        if words[:1] == ["speckle3d"]:
            yield words[1:]


def parse(words):
    """Follow the groups of commands to a command, and parse the rest with it; nothing is run."""
    command, context = app, None
    while hasattr(command, "commands"):
        assert words, "a group of commands alone"
        name, *words = words
        assert name in command.commands, f"no command {name}"
        command = command.get_command(context, name)
    words = [word for word in words if word not in ("...", "…")]
    command.make_context("speckle3d", words, parent=context, resilient_parsing=False)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_that_are_shown_exist(page):
    for line in shown_commands(page):
        for words in commands_of(line):
            try:
                parse(words)
            except Exception as error:  # of any kind: the line is named
                raise AssertionError(f"{page.name}: {line}\n{error}") from error


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_to_files(page):
    text = _CODE.sub("", page.read_text())
    for target in _LINK.findall(text):
        place = target.split("#")[0]
        if place and "://" not in target and not target.startswith("mailto:") and "generated/" not in place:
            assert (page.parent / place).exists(), f"{page.name}: {target}"


def test_the_readme_is_a_page():
    assert len((ROOT / "README.md").read_text().split()) < 900


def test_pages_are_within_the_line():
    for page in PAGES:
        if "methods" not in page.parts:
            for line in page.read_text().splitlines():
                assert len(line) <= 230 or line.startswith("|"), f"{page.name}: {line[:80]}"


@pytest.mark.parametrize("task", TASKS)
def test_the_example_of_a_task_runs(task, tmp_path, monkeypatch):
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    exec(TASKS[task]["example"], {})
