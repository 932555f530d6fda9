"""Recordings opened with what options say of them, by `convert` and by commands on tracked recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperOption

from speckle3d.cli.calibrations import fitted_pixels, mount, resize
from speckle3d.cli.common import from_options, note
from speckle3d.core.errors import InvalidInputError

if TYPE_CHECKING:
    from speckle3d.core.sweep import Sweep
    from speckle3d.io.import_settings import ImportSettings
    from speckle3d.study.posed import PosedSweep

Number = Annotated[float | None, typer.Option()]
PlusConfig = Annotated[str | None, typer.Option(metavar="FILE")]
TransformName = Annotated[str | None, typer.Option(metavar="NAME")]


class Importing(TyperCommand):
    """A command with options of `ImportSettings`, whose help texts are those of its fields."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Show the help, with the texts of fields for options that have none of their own."""
        from speckle3d.io.import_settings import ImportSettings

        for param in self.params:
            if isinstance(param, TyperOption) and param.name in ImportSettings.model_fields:
                param.help = param.help or ImportSettings.model_fields[param.name].description
        super().format_help(ctx, formatter)


@dataclass(frozen=True)
class Told:
    """What options say of a recording.

    Attributes
    ----------
    settings : ImportSettings
        With the pixel size of `fitted`.
    fitted : dict
        The pixel size that a calibration found, as far as no option gives it.
    calibration : tuple of path
    """

    settings: ImportSettings
    fitted: dict[str, float]
    calibration: tuple[Path, ...] = ()

    @classmethod
    def of(cls, source: Path, options: Mapping[str, Any], calibration: Sequence[Path] | None) -> Told:
        """Take options by their names; those that are none of `ImportSettings` or `--transform` are ignored.

        Raises
        ------
        InvalidInputError
            If the recording is not of the kind that an option is for, or says all of it itself.
        """
        from speckle3d.cli.recordings import require_sequence, require_unsaid
        from speckle3d.io.import_settings import ImportSettings

        for name in ("transform", "reference_transform", "plus_config"):
            require_sequence(source, options.get(name), f"--{name.replace('_', '-')}")
        given = from_options(ImportSettings, {**options, "tracker_transform": options.get("transform")})
        require_unsaid(source, given)
        files = tuple(calibration or ())
        fitted = {k: v for k, v in fitted_pixels(files).items() if k not in given.model_fields_set}
        return cls(given.model_copy(update=fitted), fitted, files)

    def on(self, sweep: Sweep) -> Sweep:
        """Put the calibrations on the sweep that was read with the settings."""
        return mount(resize(sweep, self.fitted), self.calibration)


def open_as_told(
    source: Path,
    mode: str | None,
    sweep_file: Path | None,
    options: Mapping[str, Any],
    calibration: Sequence[Path] | None = None,
    dynamic_range_db: float | None = None,
) -> PosedSweep:
    """Open a reconstruction, or a recording with what options say of it; tell on stderr what is left out.

    Parameters
    ----------
    options : mapping
        By name, as for `Told.of`; of a reconstruction none but None.
    dynamic_range_db : float, optional
        Of B-mode that does not say its own.

    Raises
    ------
    InvalidInputError
        If options are given with a reconstruction; else as `Told.of` and `open_posed`.
    """
    from speckle3d.io.import_settings import ImportSettings
    from speckle3d.io.load import import_notes, kind_of
    from speckle3d.io.reconstructions import FORMAT
    from speckle3d.study.posed import open_posed

    known = ("transform", *ImportSettings.model_fields)
    given = {name: value for name, value in options.items() if name in known and value is not None}
    if kind_of(source) == FORMAT:
        for name in (*given, *(["calibration"] if calibration else [])):
            raise InvalidInputError(
                f"--{name.replace('_', '-')}: expected a recording with it, got {source} ({FORMAT})"
            )
        return open_posed(source, mode, sweep_file)
    told = Told.of(source, given, calibration)
    posed = open_posed(source, mode, sweep_file, told.settings, dynamic_range_db, told.on)
    for each in (*import_notes(source, told.settings), *posed.notes()):
        note(each)
    return posed
