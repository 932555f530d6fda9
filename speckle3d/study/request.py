"""What can be asked of a sweep: checked before any work is done."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from speckle3d.config import Config
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.sweep import Sweep
from speckle3d.correction.modes import require_modes
from speckle3d.examine.sensors import cleaned_readings
from speckle3d.motion.direction import sensed_orientation
from speckle3d.scoring.references import Reference, find_reference

SUBSET = "consistent-subset"
"""Mode of the images alone with the patches that contradict the sensed orientation left out."""


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
    possible = []
    for mode in (SUBSET, "orientation", "pose", "fused"):
        with suppress(InsufficientDataError):
            require_possible(sweep, [mode], None, config)
            possible.append(mode)
    return possible
