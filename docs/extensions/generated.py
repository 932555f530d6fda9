"""Pages that the code itself knows: settings, commands and the API, written before each build."""

from __future__ import annotations

import importlib
import re
import shutil
import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic_core import PydanticUndefined
from sphinx.application import Sphinx
from sphinx.util import logging

from speckle3d.config import unit_of

LOG = logging.getLogger(__name__)

PUBLIC = ("speckle3d", "xsens")


def settings_page(title: str, groups: dict[str, type[BaseModel]], when: dict[str, dict[str, str]]) -> str:
    """Table of every setting: name, default, unit, what it is, when to change it."""
    lines = [f"# {title}", ""]
    for group, model in groups.items():
        lines += [
            f"## `{group}`" if group else "",
            "",
            "| setting | default | what it is | change it |",
            "|---|---|---|---|",
        ]
        for name, field in model.model_fields.items():
            told = when.get(group, {}).get(name)
            where = f"{group}.{name}"
            if not field.description:
                LOG.warning("%s: has no description", where)
            if told is None:
                LOG.warning("%s: reference/when.toml does not say when to change it", where)
            default = (
                "asked for" if field.default in (PydanticUndefined, None) else f"`{_shown(field.default)}`"
            )
            unit = unit_of(name)
            cells = (f"`{name}`", f"{default} {unit}".strip(), _cell(field.description), _cell(told))
            lines.append(f"| {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return str(list(value) if isinstance(value, tuple) else value)


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|")


def command_pages() -> dict[str, str]:
    """One page for each command and group of commands, by name."""
    from speckle3d.cli import app

    pages: dict[str, str] = {}
    for name in sorted(app.table):
        command = app.get_command(None, name)
        parts = [f"# `speckle3d {name}`", ""]
        if hasattr(command, "commands"):
            parts += [_text(command.help), ""]
            for inner in sorted(command.table):
                made = command.get_command(None, inner)
                parts += [f"## `speckle3d {name} {inner}`", "", *_command(made)]
        else:
            parts += _command(command)
        pages[name] = "\n".join(parts)
    return pages


def _command(command: Any) -> list[str]:
    lines = [
        _text(command.help),
        "",
        "```console",
        *(f"$ {line}" for line in command.words.examples),
        "```",
        "",
    ]
    panels: dict[str, list[Any]] = {"Arguments": [], "Options": [], "Other options": []}
    for parameter in command.params:
        options = "Options" if parameter.name in command.words.common else "Other options"
        panels["Arguments" if parameter.param_type_name == "argument" else options].append(parameter)
    for panel, held in panels.items():
        if held:
            lines += [f"{panel}:", "", "| | |", "|---|---|", *map(_option, held), ""]
    return lines


def _option(parameter: Any) -> str:
    names = ", ".join([*parameter.opts, *parameter.secondary_opts])
    if parameter.param_type_name == "argument":
        names = str(parameter.metavar or parameter.name).strip("{}").upper()
    help_text = _cell(getattr(parameter, "help", "") or "")
    if not help_text:
        LOG.warning("%s: has no help", names)
    return f"| `{names}` | {_escaped(help_text)} |"


def _text(text: str | None) -> str:
    """Paragraphs of a docstring, as Markdown."""
    paragraphs = re.split(r"\n\s*\n", (text or "").strip())
    return "\n\n".join(_escaped(" ".join(p.split())) for p in paragraphs)


def _escaped(text: str) -> str:
    return text.replace("<", "&lt;").replace("*", "\\*")


def api_pages(groups: dict[str, dict[str, Any]]) -> dict[str, str]:
    """One page for each public name, `package.name`; with its group's example if it has none of its own."""
    pages: dict[str, str] = {}
    for name in (name for group in groups.values() for name in group["names"]):
        public = _public(name)
        kind = {True: "autoclass", False: "autofunction"}[isinstance(public, type)]
        is_plain = kind == "autoclass" and not issubclass(public, (BaseModel, Exception))
        more = "\n   :members:" if is_plain else ""
        pages[name] = f"# `{name}`\n\n```{{eval-rst}}\n.. {kind}:: {name}{more}\n```\n"
        if ">>>" not in (public.__doc__ or ""):
            (example,) = (group["example"] for group in groups.values() if name in group["names"])
            pages[name] += f"\nFor example:\n\n```python\n{example.strip()}\n```\n"
    every = {f"{package}.{name}" for package in PUBLIC for name in _names(importlib.import_module(package))}
    if every != set(pages):
        LOG.warning("reference/api.toml: has not %s", ", ".join(sorted(every ^ set(pages))))
    return pages


def api_index(groups: dict[str, dict[str, Any]]) -> str:
    """Public names by task, with the first sentence of each."""
    lines = ["# Python", "", "Public names of `speckle3d` and `xsens` by task.", ""]
    for title, group in groups.items():
        lines += [f"## {title}", "", "| name | what it is |", "|---|---|"]
        for name in group["names"]:
            lines.append(
                f"| [`{name}`]({name}.md) | {_cell((_public(name).__doc__ or '').split(chr(10))[0])} |"
            )
        lines.append("")
    names = [name for group in groups.values() for name in group["names"]]
    return "\n".join([*lines, "```{toctree}", ":hidden:", "", *names, "```"])


def _public(name: str) -> Any:
    package, _, inside = name.partition(".")
    return getattr(importlib.import_module(package), inside)


def _names(module: Any) -> list[str]:
    return [
        n for n in dir(module) if not n.startswith("_") and not isinstance(getattr(module, n), type(module))
    ]


def write(app: Sphinx) -> None:
    """Write all pages below `reference/generated`."""
    from speckle3d.config import Config
    from speckle3d.io.import_settings import ImportSettings

    here = Path(app.srcdir) / "reference" / "generated"
    shutil.rmtree(here, ignore_errors=True)
    when = tomllib.loads((here.parent / "when.toml").read_text())
    groups = {name: type(field.default) for name, field in Config.model_fields.items()}
    pages = {
        "settings": settings_page("Settings", groups, when),
        "import-settings": settings_page("What a recording does not say", {"import": ImportSettings}, when),
    }
    tasks = tomllib.loads((here.parent / "api.toml").read_text())
    commands, api = command_pages(), api_pages(tasks)
    pages |= {f"commands/{name}": text for name, text in commands.items()}
    pages |= {f"api/{name}": text for name, text in api.items()}
    pages["commands/index"] = _index("Commands", "`speckle3d COMMAND --help` says the same.", commands)
    pages["api/index"] = api_index(tasks)
    for name, text in pages.items():
        path = here / f"{name}.md"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.rstrip() + "\n")


def _index(title: str, text: str, names: dict[str, str]) -> str:
    return "\n".join([f"# {title}", "", text, "", "```{toctree}", ":maxdepth: 1", "", *names, "```", ""])


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the pages' making before sources are read."""
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True}
