"""What is left of `expect`: one line about what was removed."""

from __future__ import annotations

from typing import Annotated

import typer

from speckle3d.cli.common import app
from speckle3d.core.errors import InvalidInputError


@app.command(
    "expect", hidden=True, context_settings={"allow_extra_args": True, "ignore_unknown_options": True}
)
def expect(names: Annotated[list[str] | None, typer.Argument(help="Ignored.")] = None) -> None:
    """Say what replaces `expect inertial`."""
    from speckle3d.core.reconstruction import REMOVED_MODES

    raise InvalidInputError(f"expect inertial was removed with its mode: {REMOVED_MODES['inertial']}")
