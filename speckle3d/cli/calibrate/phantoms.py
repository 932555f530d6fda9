"""Calibration of a sensor to the image with a phantom, a plane or wires, and how calibrations repeat."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.calibrations import report_written, require_free
from speckle3d.cli.common import (
    CalibrationOut,
    Images,
    Json,
    calibrate,
    emit,
    emit_json,
    from_options,
    note,
)
from speckle3d.cli.helping import Command
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.calibrating.settings import ScanSettings

METHODS = {
    "plane": "Calibrate a position sensor with the floor of a water bath, or the Cambridge phantom.",
    "orientation": "Calibrate an orientation sensor with the floor of a water bath.",
    "wires": "Calibrate a position sensor with crossing wires, three orthogonal wires or N-shapes.",
}


class _OfSettings(Command):
    """A command whose options are the fields of its settings, loaded when it is asked for them."""

    @property
    def params(self) -> list[Any]:
        """Of the command, as click has them."""
        if "_params" not in vars(self):
            alone = typer.Typer(add_completion=False)
            alone.command()(_command_of(str(self.name)))
            command = typer.main.get_command(alone)
            self._params, self.callback = list(command.params), command.callback
        return self._params

    @params.setter
    def params(self, none: list[Any]) -> None:
        """Ignore that its stand-in has none."""


def _command_of(method: str) -> Any:
    """The command of a method, with the fields of its settings as parameters."""
    from speckle3d.calibrating.settings import model_of, written_as

    def option(name: str, kind: Any, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
        only = inspect.Parameter.KEYWORD_ONLY
        return inspect.Parameter(name, only, default=default, annotation=kind)

    def command(images: Path, out: Path, as_json: bool, **options: Any) -> None:
        _calibrate(images, from_options(model_of(method), options), out, as_json)

    parameters = [option("images", Images), option("out", CalibrationOut)]
    for name, field in model_of(method).model_fields.items():
        kind, text, default = field.annotation, written_as(field), field.default
        told: dict[str, Any] = {"help": field.description}
        if text is not None:
            kind, default, told["metavar"] = str | None, None, text.metavar
        if name == "phantom":
            default = inspect.Parameter.empty  # the command asks which one
        flag = typer.Option(f"--{name.replace('_', '-')}", **told)
        parameters.append(option(name, Annotated[kind, flag], default))
    parameters.append(option("as_json", Json, False))
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {each.name: each.annotation for each in parameters}
    return command


def _add_command(method: str) -> None:
    def stand_in() -> None: ...

    stand_in.__doc__ = METHODS[method]
    calibrate.command(method, cls=_OfSettings)(stand_in)


for _method in METHODS:
    _add_command(_method)


def _calibrate(images: Path, settings: ScanSettings, out: Path, as_json: bool) -> None:
    """Calibrate, check on the other recording, and write the calibration, its report and the dots."""
    from speckle3d.calibrating.phantoms import found, opened, remarks, solved, validated, write_outcome

    if settings.validation is None and getattr(settings, "validation_points", None) is not None:
        raise InvalidInputError("--validation-points: expected the recording in --validation, got none")
    files = [getattr(settings, name, None) for name in ("points", "validation_points", "phantom")]
    others = [None if file is None else Path(file) for file in files]
    require_free(out, images, settings.poses, settings.validation, *others)
    recording = opened(images, settings, settings.poses)
    with progress_bar(f"looking into {images.name}") as progress, naming(str(images)):
        seen = found(recording, settings, getattr(settings, "points", None), progress)
    with naming(str(images)):
        outcome = solved(recording, seen, settings)
    notes = remarks(outcome)
    if settings.validation is not None:
        with progress_bar(f"looking into {settings.validation.name}") as progress:
            notes += validated(outcome, settings, progress)
    written = write_outcome(outcome, settings, images, out, notes)
    report_written(written, notes, outcome.beam, as_json)


@calibrate.command("repeatability")
def calibrate_repeatability(
    calibrations: Annotated[list[Path], typer.Argument(help="Calibration files of one mounting.")],
    size_px: Annotated[
        tuple[int, int] | None, typer.Option(help="Columns and rows of the image, for centre and corners.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare repeated calibrations: scatter of roll, yaw and tilt, and of the image's centre and corners."""
    import numpy as np

    from calibration.repeatability import repeatability
    from speckle3d.io.calibrations import read_calibration

    found = repeatability([read_calibration(path) for path in calibrations], size_px)
    roll, yaw, tilt = (float(angle) for angle in np.rad2deg(found.roll_yaw_tilt_sd_rad))
    if as_json:
        table = {
            "trials": found.trials,
            "roll_yaw_tilt_sd_deg": [roll, yaw, tilt],
            "centre_sd_mm": found.centre_sd_mm,
            "corner_sd_mm": found.corner_sd_mm,
            "centre_shift_mm": None if found.centre_shift_mm is None else found.centre_shift_mm.tolist(),
        }
        emit_json(table)
        return
    emit(f"standard deviation over {found.trials} calibrations")
    emit(f"  roll {roll:.3f}, yaw {yaw:.3f}, tilt {tilt:.3f} deg")
    if found.centre_shift_mm is None:
        if size_px is None:
            note("with --size-px COLUMNS ROWS also the scatter of the image's centre and corners")
        return
    emit(f"  centre {found.centre_sd_mm:.3f} mm, corners {found.corner_sd_mm:.3f} mm")
    shifts = ", ".join(f"{shift:.2f}" for shift in found.centre_shift_mm)
    emit(f"centre against the first calibration: {shifts} mm")
