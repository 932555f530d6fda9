"""Details of a reconstruction for its summary: fits, claims, doubts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from speckle3d.core.doubts import Doubt
from speckle3d.core.reconstruction import Provenance
from speckle3d.core.sweep import Sweep
from speckle3d.correction.drift import DriftCorrection
from speckle3d.correction.modes import sensor_of
from speckle3d.corrections import Correction
from speckle3d.matching.quality import describe
from speckle3d.scoring.lengths import TRACKER
from speckle3d.study.results import read_summary
from speckle3d.tracked import Tracked


def recorded_doubts(path: Path, provenance: Provenance) -> tuple[Doubt, ...] | None:
    """Read the doubts in the ``summary.json`` beside a reconstruction.

    Parameters
    ----------
    path : path
        The reconstruction's file.
    provenance : Provenance
        Of the reconstruction: a summary of another recording does not count.

    Returns
    -------
    tuple of Doubt, or None
        None if no summary of this reconstruction is there.
    """
    try:
        summary = read_summary(path.parent, "")
        input_sha256 = summary.details["provenance"]["input_sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return tuple(summary.doubts) if input_sha256 == provenance.input_sha256 else None


def doubted_modes(sweep: Sweep, doubts: Sequence[Doubt], modes: Collection[str]) -> dict[str, str]:
    """Suspected causes of doubts by mode, from the images and sensors each mode uses."""
    suspicions = {}
    for mode in modes:
        sensor = None if mode == "image" else sensor_of(sweep, "pose" if mode == TRACKER else mode)
        about = {"" if sensor is None else sensor.label}
        if mode != TRACKER:
            about |= {"images", "curves"}
        suspects = dict.fromkeys(d.suspect for d in doubts if d.about in about and d.suspect)
        if suspects:
            suspicions[mode] = ", ".join(suspects)
    return suspicions


def details_of(
    tracked: Tracked, corrections: Mapping[str, Correction], provenance: Provenance
) -> dict[str, Any]:
    """Details of a reconstruction beside its errors, by name."""
    fits: dict[str, dict[str, Any]] = {}
    for mode, fit in corrections.items():
        if isinstance(fit, DriftCorrection):
            parameters = dict(zip(fit.names, fit.fit.x.tolist(), strict=True))
            fits[mode] = {"curves": fit.settings.curves, "coverage": fit.coverage, "parameters": parameters}
        else:
            sources = [evidence.source for evidence in fit.evidence]
            fits[mode] = {"length_over_images": fit.scale, "rests_on": sources, **fit.details}
    return {
        "provenance": provenance,
        "pairs": tracked.pairs,
        "flagged_frames": describe(tracked.flags),
        "rejected_patch_share": tracked.rejected_share,
        "direction": tracked.direction,
        "direction_from": tracked.direction_from,
        "corrections": fits,
    }
