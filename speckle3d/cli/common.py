"""What the commands share: the application, options, settings, progress, and output."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from speckle3d.cli.helping import App
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.printable import printable

if TYPE_CHECKING:
    from pydantic import BaseModel

    from speckle3d.config import Config

    Model = TypeVar("Model", bound=BaseModel)

app = App(
    name="speckle3d",
    help="Freehand 2-D ultrasound sweeps to measured 3-D.",
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(asked: bool) -> None:
    if asked:
        from speckle3d import __version__

        emit(f"speckle3d {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Freehand 2-D ultrasound sweeps to measured 3-D."""


calibrate = App(help="Calibrate what a reconstruction needs.")
app.add_typer(calibrate, name="calibrate")

Json = Annotated[bool, typer.Option("--json", help="Print machine-readable results on stdout.")]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="TOML with settings to change; see `speckle3d config`.")
]
CalibrationFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--calibration", help="Calibration to use for its sensor in place of the file's; may be repeated."
    ),
]
Images = Annotated[
    Path,
    typer.Argument(metavar="IMAGES", help="Recording: a sweep file, an image sequence, a scanner's package."),
]
CalibrationOut = Annotated[
    Path, typer.Option("-o", "--output", help="Calibration file to write; .txt and .png beside it.")
]
Poses = Annotated[
    Path | None, typer.Option("--poses", help="File with the sensor's readings, if not in IMAGES.")
]
Transform = Annotated[
    str | None,
    typer.Option(
        "--transform",
        metavar="NAME",
        help="Poses to use, by their name in an image sequence, as ToolToTracker (ProbeToTracker).",
    ),
]
PixelMm = Annotated[
    tuple[float, float] | None,
    typer.Option(help="Distance between columns and rows, mm, if IMAGES does not say."),
]
Region = Annotated[
    str | None, typer.Option(help='Polygon "column,row column,row ..." outside which nothing counts.')
]

ReconstructionFile = Annotated[
    Path,
    typer.Argument(metavar="RECONSTRUCTION", help="reconstruction.h5 of a results folder."),
]
PosedFile = Annotated[
    Path,
    typer.Argument(
        metavar="INPUT",
        help="reconstruction.h5 of a results folder, or a recording with a calibrated tracker or true poses.",
    ),
]
_MODE_HELP = (
    "Which poses to use: image (default), orientation, pose, crossed, fused of a reconstruction; "
    "tracker, truth of a recording."
)
Mode = Annotated[str | None, typer.Option(help=_MODE_HELP)]
Modes = Annotated[list[str] | None, typer.Option("--mode", help=f"{_MODE_HELP} May be repeated.")]
SweepFile = Annotated[
    Path | None, typer.Option("--sweep", help="The sweep, if it moved since the reconstruction.")
]


def note(text: str) -> None:
    """Print a remark of one line on stderr, apart from the results; what it quotes is shown escaped."""
    sys.stderr.write(f"{_encodable(printable(text), sys.stderr.encoding)}\n")


def emit(text: str) -> None:
    """Print results on stdout; but for line breaks, characters that drive a terminal are shown escaped."""
    shown = _encodable(printable(text, kept="\n"), sys.stdout.encoding)
    try:
        sys.stdout.write(shown if shown.endswith("\n") else shown + "\n")
        sys.stdout.flush()
    except OSError as error:
        raise FileError(f"standard output: cannot be written: {error.strerror}") from error


def _encodable(text: str, encoding: str | None) -> str:
    """Escape what a terminal of another encoding than Unicode cannot show."""
    name = encoding or "utf-8"
    return text.encode(name, "backslashreplace").decode(name)


def emit_json(values: Any) -> None:
    """Print results as JSON on stdout."""
    emit(json.dumps(values, indent=2))


def emit_rows(rows: Sequence[tuple[str, Any, str]], as_json: bool) -> None:
    """Print rows of description, value and unit on stdout, aligned or as JSON."""
    from speckle3d.core.tables import text_rows

    if as_json:
        emit_json([{"description": d, "value": v, "unit": u} for d, v, u in rows])
    else:
        emit(text_rows(rows))


def load_settings(path: Path | None) -> Config:
    """Read the configuration in a file, or take the default one."""
    from speckle3d.config import Config, load_config

    return load_config(path) if path else Config()


def from_options(model: type[Model], options: Mapping[str, Any]) -> Model:
    """Make settings from the options that were given; names that are no settings are ignored.

    Raises
    ------
    InvalidInputError
        Naming the first option whose value is out of range.
    """
    names = model.model_fields
    with naming_options():
        return model(**{name: v for name, v in options.items() if name in names and v is not None})


@contextmanager
def naming_options() -> Iterator[None]:
    """Name the command-line option of the first setting that pydantic refuses in the block."""
    from pydantic import ValidationError

    try:
        yield
    except ValidationError as error:
        from speckle3d.io.toml import first_fault

        name, fault = first_fault(error)
        raise InvalidInputError(f"--{name.replace('_', '-')}: {fault}") from None
