"""Calibration files, written with their report beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from calibration.report import text_report
from speckle3d.core.calibration import Calibration, Source
from speckle3d.io.family.calibrations import write_calibration
from speckle3d.io.fileset import FileSet
from speckle3d.io.hdf5 import atomic_path
from speckle3d.io.load import recording_sha256
from speckle3d.study.figures import save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calibration.beam import BeamBias

BESIDE = (".txt", ".png", ".csv")
"""What lies beside a calibration file: its table, its pictures, and the dots it was made from."""


@dataclass(frozen=True)
class Written:
    """A calibration as it was written.

    Attributes
    ----------
    calibration : Calibration
        With what it was made from.
    table : str
        Its report.
    files : tuple of Path
        The calibration file, the table and the pictures.
    """

    calibration: Calibration
    table: str
    files: tuple[Path, ...]


def write_with_report(
    calibration: Calibration,
    inputs: Sequence[Path],
    out: Path,
    figure: Figure,
    notes: Sequence[str],
    beam: Sequence[BeamBias] = (),
    dots: Callable[[Path], None] | None = None,
    settings_json: str = "",
) -> Written:
    """Write a calibration, its table and its pictures, together.

    Parameters
    ----------
    inputs : sequence of Path
        Recordings it was made from, named in the file with their hashes.
    figure : Figure
        Its pictures.
    notes : sequence of str
        What else the table says.
    dots : callable, optional
        Writes the dots that the calibration was made from into a CSV.
    settings_json : str
        Settings that made it, kept in the file.
    """
    names, hashes = (" ".join(map(of, inputs)) for of in (str, recording_sha256))
    calibration = replace(calibration, source=Source(names, hashes, version("speckle3d"), settings_json))
    table = text_report(calibration, beam, notes)
    text, pictures, points = (out.with_suffix(suffix) for suffix in BESIDE)
    files = FileSet(out.name, (text.name, pictures.name, *([points.name] if dots else [])))
    with files.replaced(out.parent) as part:
        write_calibration(part / out.name, calibration)
        with atomic_path(part / text.name) as path:
            path.write_text(table, encoding="utf-8")
        save_figure(figure, part / pictures.name)
        if dots:
            dots(part / points.name)
    return Written(calibration, table, (out, text, pictures))
