"""What to reconstruct and how: checked before any work is done."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.printable import written_path
from speckle3d.core.reconstruction import SourceFile
from speckle3d.core.sweep import Sweep
from speckle3d.correction.modes import require_modes
from speckle3d.examine.sensors import cleaned_readings
from speckle3d.io.hdf5 import PathLike
from speckle3d.io.load import recording_sha256
from speckle3d.motion.direction import sensed_orientation
from speckle3d.scoring.references import Reference, find_reference

SUBSET = "consistent-subset"
"""Mode of the images alone with the patches that contradict the sensed orientation left out."""


@dataclass(frozen=True)
class Request:
    """A sweep to reconstruct, and everything that determines the result.

    Attributes
    ----------
    sweep : Sweep
    source : path
        The sweep's file, whose SHA-256 goes into the results.
    curves : DecorrelationCurves
    modes : sequence of str
        Beside `image`.
    reference : {"tracker", "truth"}, optional
        What to compare with; by default the truth if stored, else the tracker, else nothing.
    config : Config
    calibrations : sequence of path
        Calibration files, at most one for each sensor, in place of what the sweep says of its sensors.
    crossing : tuple of Sweep and path, optional
        A second sweep over the same tissue and its file, for the modes `crossed` and `fused`.
    """

    sweep: Sweep
    source: Path
    curves: DecorrelationCurves
    modes: Sequence[str] = ()
    reference: str | None = None
    config: Config = field(default_factory=Config)
    calibrations: Sequence[PathLike] = ()
    crossing: tuple[Sweep, Path] | None = None

    @property
    def crossing_file(self) -> SourceFile | None:
        """The crossing sweep's file, for the record."""
        if self.crossing is None:
            return None
        path = self.crossing[1]
        return SourceFile(written_path(path), recording_sha256(path))


def require_possible(
    sweep: Sweep, modes: Sequence[str], reference: str | None, config: Config, crossing: bool = False
) -> Reference | None:
    """Check that a sweep has what is asked of it, before any work is done; returns the reference.

    Parameters
    ----------
    crossing : bool
        Whether there is a crossing sweep.

    Raises
    ------
    InvalidInputError, InsufficientDataError
        If it does not have it, naming the mode or the reference.
    """
    require_modes(sweep, [mode for mode in modes if mode != SUBSET], crossing)
    if SUBSET in modes and sensed_orientation(sweep, config.sensors) is None:
        raise InsufficientDataError(
            f"{sweep.name}: mode {SUBSET}: expected sensed orientation over every frame and the setting "
            "sensors.consistent_subset, got none"
        )
    return find_reference(cleaned_readings(sweep)[0] if config.sensors.examine else sweep, reference)


def available_modes(sweep: Sweep, config: Config) -> list[str]:
    """Modes beside `image` that need no more than the sweep's sensors, calibrated to the image."""
    found = []
    for mode in (SUBSET, "orientation", "pose", "fused"):
        with suppress(InsufficientDataError):
            require_possible(sweep, [mode], None, config)
            found.append(mode)
    return found
