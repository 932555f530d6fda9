"""Tracked sweeps corrected in every mode: by cubics, a crossing sweep, inertia, all that is known.

The solvers of the last two are imported when they are asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from speckle3d.config import Config
from speckle3d.core.arrays import BoolArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.errors import InsufficientDataError, MismatchError, naming
from speckle3d.core.expected import require_kind
from speckle3d.core.geometry import elevational_steps
from speckle3d.core.sweep import OrientationSensor, Sweep
from speckle3d.correction.crossing.pair import CrossedPair
from speckle3d.correction.drift import DriftCorrection
from speckle3d.correction.modes import PUBLISHED, correct_mode, require_modes, sensor_of
from speckle3d.correction.scale import FusedPoses, ScaledPoses, ScaleEvidence
from speckle3d.correction.trust import ORIENTATION, believed, cleaned_readings, require_believed
from speckle3d.pipeline import Tracked

Correction = DriftCorrection | ScaledPoses | FusedPoses


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
        ``"crossed"``, ``"inertial"`` and ``"fused"``.
    config : Config, optional
    crossed : CrossedPair, optional
        Of this sweep and another, in either order, from `cross_sweeps`.

    Returns
    -------
    dict of str to DriftCorrection, ScaledPoses or FusedPoses
        By mode; ``poses`` are ``world_from_image``, in the sensor's world if there is one.

    Raises
    ------
    InvalidInputError
        If a mode is unknown.
    InsufficientDataError
        If what a mode needs is missing, not calibrated to the image, covers too little of the sweep, or does
        not determine the length.
    MismatchError
        If the images, or its own readings, refute a mode's sensor; see `Tracked.doubts`.

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
    require_kind(tracked, Tracked, "tracked", "track(sweep, curves)")
    require_kind(sweep, Sweep, "sweep", "load_sweep(path)")
    settings, modes = config or Config(), [modes] if isinstance(modes, str) else modes
    require_modes(sweep, modes, crossed is not None)
    for mode in modes:
        if mode != "fused":
            require_believed(tracked.doubts, sensor_of(sweep, mode), f"{sweep.name}: drift mode {mode}")
    if settings.sensors.examine:
        sweep, _ = cleaned_readings(sweep)
    found: dict[str, Correction] = {}
    for mode in modes:
        if mode in PUBLISHED:
            # What wander the sensed orientation shows, cubics need not make up for.
            start = tracked.subset if tracked.subset is not None else tracked.image
            found[mode] = correct_mode(mode, start, sweep, settings.drift)
        elif mode == "crossed" and crossed is not None:
            found[mode] = crossed.of(sweep.frame_time_s, sweep.name)
        elif mode == "inertial":
            found[mode] = _inertial(tracked, sweep, settings)
        elif mode == "fused":
            found[mode] = _fused(tracked, sweep, settings, crossed)
    return found


def steps_turned(inertial: ScaledPoses, tracked: Tracked, sweep: Sweep) -> BoolArray:
    """Steps that the accelerometer feels to go the other way than the images have them, shape (n - 1,)."""
    felt, seen = (elevational_steps(poses, sweep.grid.centre_mm) for poses in (inertial.poses, tracked.image))
    return np.asarray(felt * seen < 0)


def _inertial(tracked: Tracked, sweep: Sweep, config: Config) -> ScaledPoses:
    from speckle3d.correction.inertial.scale import correct_inertial

    sensor = sweep.orientation
    assert isinstance(sensor, OrientationSensor)
    with naming(f"{sweep.name}: drift mode inertial"):
        return correct_inertial(
            tracked.image,
            tracked.covariance,
            tracked.scale_sigma,
            sensor,
            sweep.frame_time_s,
            sweep.grid.centre_mm,
            config.inertial,
        )


def _fused(tracked: Tracked, sweep: Sweep, config: Config, crossed: CrossedPair | None) -> FusedPoses:
    """Fuse with what is left of the sensors once those that are refuted are out."""
    from speckle3d.correction.fused.fuse import fuse

    sweep = believed(sweep, tracked.doubts)
    evidence: list[ScaleEvidence] = []
    if crossed is not None:
        evidence += crossed.of(sweep.frame_time_s, sweep.name).evidence
    refuted: tuple[Doubt, ...] = ()
    felt_back = None
    try:
        require_modes(sweep, ["inertial"])
        inertial = _inertial(tracked, sweep, config)
        evidence += inertial.evidence
        felt_back = steps_turned(inertial, tracked, sweep)
    except MismatchError as error:
        refuted = (Doubt(ORIENTATION, "accelerometer or gyroscope", str(error), True),)
    except InsufficientDataError:
        pass  # most sweeps lack a motion that gives the accelerometer a scale, and do without
    with naming(f"{sweep.name}: drift mode fused"):
        found = fuse(
            tracked.edges,
            tracked.image,
            tracked.covariance,
            tracked.scale_sigma,
            tracked.slopes.deviation_per_mm,
            sweep.grid.centre_mm,
            sweep.frame_time_s,
            sweep.orientation,
            sweep.tracker,
            evidence,
            felt_back,
            config.fused,
        )
    return replace(found, contradictions=(*found.contradictions, *refuted))
