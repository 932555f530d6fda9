"""Decorrelation curves from phantom sweeps whose positions are known.

RF -> intensity -> in-plane motion -> patch correlation -> correlation against |distance|, by depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.progress import Progress, after
from speckle3d.core.sweep import Sweep
from speckle3d.matching.frames import match_sweep
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.schedule import KnownSchedule
from speckle3d.matching.texture import PHANTOM_FRAMES, mean_spectra
from speckle3d.motion.phantom import fit_curves, phantom_pairs, phantom_samples, phantom_speckle


def calibrate_curves(
    sweeps: Sequence[Sweep], config: Config | None = None, progress: Progress | None = None
) -> DecorrelationCurves:
    """Measure decorrelation curves on phantom sweeps whose positions are known.

    Parameters
    ----------
    sweeps : sequence of Sweep
        Fully developed speckle in steps or by hand; with some that turn, the curves learn what tilt does.
    config : Config, optional
    progress : callable, optional
        Called with frames done and frames in all.

    Returns
    -------
    DecorrelationCurves

    Raises
    ------
    InsufficientDataError
        If positions are not known, or the distances do not span the curves.
    MismatchError
        If the sweeps differ in probe, frequency or sampling.
    """
    settings = config or Config()
    if not sweeps:
        raise InsufficientDataError("expected at least one phantom sweep, got none")
    samples, keys, sizes, spectra = [], [], [], []
    total, before = sum(len(sweep) for sweep in sweeps), 0
    for sweep in sweeps:
        matcher = FrameMatcher(
            sweep, settings.intensity, settings.patches, settings.inplane, settings.matching
        )
        keys.append(matcher.key)
        keys[0].require_same(matcher.key, "the phantom sweeps do not match each other")
        wanted = phantom_pairs(sweep, settings.curves)
        matches = match_sweep(
            sweep,
            matcher,
            KnownSchedule(wanted),
            settings.quality,
            after(progress, before, total),
            textures=PHANTOM_FRAMES,
        )
        samples.append(phantom_samples(sweep, matcher.patches, matches.table, wanted))
        sizes.append((matcher.patches.row_depth_mm, matches.texture.speckle_size()))
        spectra.append(matches.texture.spectra())
        before += len(sweep)
    curves = fit_curves(keys[0], samples, settings.curves)
    return replace(
        curves,
        speckle=phantom_speckle(curves.depth_mm, sizes),
        spectrum=mean_spectra([each for each in spectra if each is not None]),
    )
