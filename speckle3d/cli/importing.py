"""Options that say what a recording does not say itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperOption

from speckle3d.cli.common import from_options
from speckle3d.cli.helping import Command

if TYPE_CHECKING:
    from speckle3d.io.import_settings import ImportSettings

Number = Annotated[float | None, typer.Option()]
PlusConfig = Annotated[str | None, typer.Option(metavar="FILE")]
ReferenceTransform = Annotated[str | None, typer.Option(metavar="NAME")]
_PANEL = "What the recording does not say"


class Importing(Command):
    """A command with options of `ImportSettings`, whose help texts are those of its fields."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help, with descriptions of settings where an option has none of its own."""
        self.describe()
        super().format_help(ctx, formatter)

    def describe(self) -> None:
        """Give options that are settings the settings' descriptions, and a panel of their own."""
        from speckle3d.io.import_settings import ImportSettings

        for param in self.params:
            if isinstance(param, TyperOption) and param.name in ImportSettings.model_fields:
                param.help = param.help or ImportSettings.model_fields[param.name].description
                param.rich_help_panel = _PANEL


def given_settings(source: Path, options: Mapping[str, Any]) -> ImportSettings:
    """Import settings among a command's options.

    Parameters
    ----------
    source : path
        The recording.
    options : mapping of str to object
        All options of the command; `transform` is the tracker's.

    Raises
    ------
    InvalidInputError
        If an option is for another kind of recording, or the recording says the same itself.
    """
    from speckle3d.calibrating.recordings import require_sequence, require_unsaid
    from speckle3d.io.import_settings import ImportSettings

    for name in ("transform", "reference_transform", "plus_config"):
        require_sequence(source, options[name], f"--{name.replace('_', '-')}")
    given = from_options(ImportSettings, {**options, "tracker_transform": options["transform"]})
    require_unsaid(source, given)
    return given


def files_of(plus_config: str | None, calibrations: Sequence[Path] | None) -> tuple[Path, ...]:
    """Files that options name, which a command must not write over."""
    return (*(calibrations or ()), *([] if plus_config is None else [Path(plus_config)]))
