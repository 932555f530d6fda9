"""Correct tracked sweeps in every mode."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from speckle3d.config import Config
from speckle3d.core.errors import MismatchError, naming
from speckle3d.core.reconstruction import SharedErrors
from speckle3d.core.sweep import Sweep
from speckle3d.correction.crossing.pair import CrossedPair
from speckle3d.correction.drift import DriftCorrection
from speckle3d.correction.fused import FusionProblem, fuse
from speckle3d.correction.modes import CUBIC_MODES, correct_mode, require_modes, sensor_of
from speckle3d.correction.scale import ScaledPoses
from speckle3d.examine.sensors import credible_sensors, repair_readings, require_credible
from speckle3d.motion.uncertainty import shared_covariance
from speckle3d.tracked import Tracked
from speckle3d.tracking import require_kind

Correction = DriftCorrection | ScaledPoses


def correct(
    tracked: Tracked,
    sweep: Sweep,
    modes: Sequence[str] | str,
    config: Config | None = None,
    crossed: CrossedPair | None = None,
) -> dict[str, Correction]:
    """Correct the drift of the image-based poses in each of `modes`.

    Parameters
    ----------
    tracked : Tracked
    sweep : Sweep
        From which `tracked` was made.
    modes : sequence of str, or str
        One or several among ``"orientation"`` (three curves) and ``"pose"`` (six), which are as published,
        ``"crossed"`` and ``"fused"``.
    config : Config, optional
    crossed : CrossedPair, optional
        Of this sweep and another, in either order, from `cross_sweeps`.

    Returns
    -------
    dict of str to DriftCorrection or ScaledPoses
        By mode; ``poses`` are ``world_from_image``, in the sensor's world if there is one.

    Raises
    ------
    InvalidInputError
        If a mode is unknown.
    InsufficientDataError
        If what a mode needs is missing, not calibrated to the image, covers too little of the sweep, or does
        not determine the length.
    MismatchError
        If a mode's sensor contradicts itself (see `Tracked.doubts`), or fused images and tracker differ in
        length by more than a factor of two.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, equations 1 to 5.

    Examples
    --------
    >>> import speckle3d as s3
    >>> sweep = s3.load_sweep("data/phantom.h5").part(0, 32)
    >>> tracked = s3.track(sweep, s3.load_curves("data/curves.h5"))
    >>> corrected = s3.correct(tracked, sweep, ["orientation", "pose"])
    >>> [len(corrected[mode].poses) for mode in ("orientation", "pose")]
    [32, 32]
    """
    require_kind(tracked, Tracked, "track(sweep, curves)")
    require_kind(sweep, Sweep, "load_sweep(path)")
    settings, modes = config or Config(), [modes] if isinstance(modes, str) else modes
    require_modes(sweep, modes, crossed is not None)
    for mode in modes:
        if mode != "fused":
            require_credible(tracked.doubts, sensor_of(sweep, mode), f"{sweep.name}: drift mode {mode}")
    if settings.sensors.examine:
        sweep, _ = repair_readings(sweep)
    share, centre_mm = float(tracked.coherence.share.mean()), sweep.grid.centre_mm
    images = tracked.edges, tracked.image, share, tracked.shared, centre_mm, sweep.frame_time_s
    corrections: dict[str, Correction] = {}
    for mode in modes:
        if mode in CUBIC_MODES:
            # What wander the sensed orientation shows, cubics need not make up for.
            start = tracked.subset if tracked.subset is not None else tracked.image
            # Turns are the sensor's, and what the images' move the path by is no error of it.
            turns = SharedErrors(0.0, 0.0, tracked.shared.turn_sigma_per_mm)
            places = tracked.covariance - shared_covariance(tracked.image, centre_mm, turns)
            wander_mm = 0.0
            if mode == "pose":  # whose curves follow the tracker's slow errors: beside the images they show
                with suppress(MismatchError):
                    problem = FusionProblem.of(*images, tracker=sweep.tracker, settings=settings.fused)
                    sizes_mm = [float(sensor.wander.max()) for sensor in problem.solve()[2].sensors]
                    wander_mm = max(sizes_mm, default=0.0)
            corrections[mode] = correct_mode(
                mode, start, sweep, settings.drift, places, settings.fused, wander_mm
            )
        elif mode == "crossed" and crossed is not None:
            corrections[mode] = crossed.of(sweep.frame_time_s, sweep.name)
        elif mode == "fused":
            evidence = None if crossed is None else crossed.of(sweep.frame_time_s, sweep.name).evidence
            credible = credible_sensors(sweep, tracked.doubts)
            with naming(f"{sweep.name}: drift mode fused"):
                problem = FusionProblem.of(
                    *images, credible.orientation, credible.tracker, evidence, settings.fused
                )
                corrections[mode] = fuse(problem, centre_mm)
    return corrections
