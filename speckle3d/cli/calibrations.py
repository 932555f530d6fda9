"""What options say of a recording: settings and calibrations; where calibrations may be written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from speckle3d.cli.common import emit, emit_json, from_options, note
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError

if TYPE_CHECKING:
    from calibration.beam import BeamBias
    from speckle3d.calibrating.written import Written
    from speckle3d.core.sweep import Sweep
    from speckle3d.io.import_settings import ImportSettings

NOTED_DEG, NOTED_MM = 5.0, 10.0
"""Difference of mountings that is reported: calibrations of one mounting differ by less."""


def given_settings(source: Path, imported: Mapping[str, Any], transform: str | None) -> ImportSettings:
    """Settings of an import from options; `transform` is the tracker's.

    Raises
    ------
    InvalidInputError
        If the recording says the same itself.
    """
    from speckle3d.calibrating.recordings import require_unsaid
    from speckle3d.io.import_settings import ImportSettings

    named = {} if transform is None else {"tracker_transform": transform}
    given = from_options(ImportSettings, {**imported, **named})
    require_unsaid(source, given)
    return given


def files_of(imported: Mapping[str, Any], calibrations: Sequence[Path] | None) -> tuple[Path, ...]:
    """Files that options name, which a command must not write over."""
    return (*(calibrations or ()), *(Path(imported[name]) for name in ("plus_config",) if name in imported))


def require_free(out: Path, *inputs: Path | None) -> None:
    """Refuse to write a calibration over another kind of file, or its report over an input.

    Raises
    ------
    FileError
        If the place cannot be written.
    InvalidInputError
        If it is taken.
    """
    from speckle3d.calibrating.written import BESIDE

    if out.suffix in BESIDE:
        raise InvalidInputError(
            f"{out}: expected a calibration file, not {', '.join(BESIDE)}, which are written beside it"
        )
    require_own_place(out, "calibration", *inputs)
    beside = {out.with_suffix(suffix).resolve() for suffix in BESIDE}
    for path in inputs:
        if path is not None and path.resolve() in beside:
            raise InvalidInputError(f"{path}: would be overwritten by the results: give -o another name")


def report_written(
    written: Written, notes: Sequence[str], beam: Sequence[BeamBias] = (), as_json: bool = False
) -> None:
    """Print the table of a calibration that was written, and where it is."""
    from calibration.report import json_report

    if as_json:
        emit_json(json_report(written.calibration, beam) | {"notes": list(notes)})
    else:
        emit(written.table)
    out, text, pictures = written.files
    note(f"calibration in {out}, report in {text} and {pictures}")


def mount(sweep: Sweep, paths: Sequence[Path]) -> Sweep:
    """Put calibration files on a sweep's sensors, and report on stderr where they contradict the sweep."""
    from speckle3d.core.calibration import mounting_difference
    from speckle3d.io.calibrations import apply_calibrations, read_calibration

    mounted, _ = apply_calibrations(sweep, paths)
    for path in paths:
        calibration = read_calibration(path)
        turned_deg, moved_mm = mounting_difference(sweep, calibration)
        if turned_deg > NOTED_DEG or moved_mm > NOTED_MM:
            moved = f" and {moved_mm:.0f} mm" if calibration.sensor == "tracker" else ""
            note(
                f"{path}: puts the image {turned_deg:.0f} degrees{moved} from where the sweep has it on the "
                f"{calibration.sensor} sensor, and is used: is it of this mounting?"
            )
    return mounted
