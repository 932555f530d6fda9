"""Faults put into good recordings: what cables, converters, calibrations and operators do wrong.

Each of `FAULTS` changes a sweep, the curves that it is read with, or both, and says what an honest program
does with the result. ``FAULTS_BY_NAME["tracker in metres"].into(sweep)`` is the faulty sweep.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np
from tampering import (
    Change,
    all_frames,
    clock_late,
    clock_rate,
    clutter,
    depths,
    flipping,
    frozen_display,
    heading_drift,
    held,
    in_order,
    inertial,
    interleaved,
    inverted,
    jumping,
    keyed_twice,
    mount_turned,
    mounted,
    noisy,
    of_images,
    of_orientation,
    of_tracker,
    on_64_to_100_mm,
    random_poses,
    random_turns,
    resting,
    rounded,
    sampled_and_held,
    scaled,
    seen_in_mirror,
    stored_xyzw,
    stream_of_another,
    stretched,
    swapped_axes,
    tracker_of_another,
    transposed,
    twice,
    upside_down,
    walking,
    with_factors,
)

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.sweep import Sweep
from speckle3d.simulation.sensors import GRAVITY_M_S2

Honest = Literal["refuse", "say", "stand"]
"""What an honest program does. refuse: it leaves out what rests on the bad input. say: it refuses, or gives a
result and its doubt. stand: it may also say nothing, where the result is as good as without the fault."""


@dataclass(frozen=True)
class Fault:
    """One fault.

    Parameters
    ----------
    about : str
        What is bad, as `Doubt.about` names it; a doubt about anything else blames the innocent.
    suspects : tuple of str
        Words of which one must be in `Doubt.suspect`; () where the cause cannot be told from the effect.
    corrupts : tuple of str
        What rests on it: modes, and "sign" for the sign of the elevational motion.
    """

    name: str
    about: str
    suspects: tuple[str, ...]
    corrupts: tuple[str, ...]
    honest: Honest
    change: Change = field(default=lambda sweep, rng: sweep)
    change_curves: Callable[[DecorrelationCurves], DecorrelationCurves] = field(default=lambda curves: curves)

    def into(self, sweep: Sweep, seed: int = 0) -> Sweep:
        """The sweep with this fault."""
        return self.change(sweep, np.random.default_rng([seed, *self.name.encode()]))

    def into_curves(self, curves: DecorrelationCurves) -> DecorrelationCurves:
        """The curves with this fault."""
        return self.change_curves(curves)

    def concerns(self, sweep: Sweep) -> bool:
        """Whether the sweep has what this fault spoils."""
        if self.about == "orientation sensor":
            inertial = "gyroscope" in self.name or "acceler" in self.name
            has = sweep.orientation is not None
            return has and not (inertial and sweep.orientation.gyroscope_rad_s is None)
        return self.about != "tracker" or sweep.tracker is not None


_METRES, _INCHES, _CM = 1e-3, 1 / 25.4, 0.1
_ALL = ("sign", "orientation", "pose")
_PLACE = ("sign", "pose")

_UNITS, _HAND, _MOUNT, _CLOCK = (
    ("unit", "scale"),
    ("hand", "mirror", "inver", "transposed", "mount"),
    ("mount",),
    ("clock",),
)
_FROZEN = ("frozen", "stuck", "constant")
_ANY: tuple[str, ...] = ()


def _about_tracker(
    name: str, suspects: tuple[str, ...], corrupts: tuple[str, ...], honest: Honest, change: Change
) -> Fault:
    return Fault(f"tracker {name}", "tracker", suspects, corrupts, honest, change)


TRACKER = (
    _about_tracker("in metres", _UNITS, _PLACE, "refuse", of_tracker(scaled, _METRES)),
    _about_tracker("in centimetres", _UNITS, _PLACE, "refuse", of_tracker(scaled, _CM)),
    _about_tracker("in inches", _UNITS, _PLACE, "refuse", of_tracker(scaled, _INCHES)),
    _about_tracker("x 1.1", _UNITS, ("pose",), "say", of_tracker(scaled, 1.1)),
    _about_tracker("x 0.9", _UNITS, ("pose",), "say", of_tracker(scaled, 0.9)),
    _about_tracker("frozen", _FROZEN, _ALL, "refuse", of_tracker(held, 0.0)),
    _about_tracker("frozen from halfway", _FROZEN, _ALL, "refuse", of_tracker(held, 0.5)),
    _about_tracker("frozen in the middle fifth", _FROZEN, _ALL, "say", of_tracker(held, 0.4, 0.6)),
    _about_tracker("held for eight readings", _FROZEN, _ALL, "stand", of_tracker(sampled_and_held, 8)),
    _about_tracker("mirrored", _HAND, _ALL, "refuse", of_tracker(seen_in_mirror)),
    _about_tracker("axes swapped", _HAND, _ALL, "refuse", of_tracker(swapped_axes)),
    _about_tracker(
        "z of the other sign",
        _HAND,
        _PLACE,
        "refuse",
        of_tracker(scaled, [1.0, 1.0, -1.0]),
    ),
    _about_tracker("matrices inverted", _HAND, _ALL, "refuse", of_tracker(inverted)),
    _about_tracker("rotations transposed", _HAND, _ALL, "refuse", of_tracker(transposed)),
    *(
        _about_tracker(
            f"mount turned by {degrees} deg about {axis}",
            _MOUNT,
            _ALL,
            "say" if degrees < 90 else "refuse",
            mounted("tracker", partial(mount_turned, degrees, axis)),
        )
        for degrees in (20, 180)
        for axis in "xyz"
    ),
    _about_tracker(
        "mount inverted",
        (*_MOUNT, *_HAND),
        _ALL,
        "refuse",
        mounted("tracker", lambda mount: mount.inv()),
    ),
    *(
        _about_tracker(
            f"clock off by {late} s",
            _CLOCK,
            _ALL,
            "stand" if abs(late) < 0.25 else "say",
            clock_late("tracker", late),
        )
        for late in (0.1, 0.25, -0.25, 0.5, 1.0)
    ),
    _about_tracker("clock 10 % fast", _CLOCK, _ALL, "stand", clock_rate("tracker", 1 / 1.1)),
    _about_tracker(
        "spikes of 30 mm",
        ("spike", "jump", "outlier"),
        _PLACE,
        "say",
        of_tracker(jumping, 0.05, 30.0),
    ),
    _about_tracker("noise of 3 mm", ("noise", "jitter"), _PLACE, "say", of_tracker(noisy, 3.0)),
    _about_tracker("drift of 5 mm", _ANY, _PLACE, "say", of_tracker(walking, 5.0)),
    _about_tracker("random", _ANY, _ALL, "refuse", of_tracker(random_poses)),
    _about_tracker("of another sweep", _ANY, _ALL, "refuse", tracker_of_another),
)


# --- orientation sensors --------------------------------------------------------------------------------


_TURNS = ("sign", "orientation")
_ORDER = ("order", "wxyz", "xyzw", "quaternion", "inver", "hand", "mount")


def _about_orientation(
    name: str, suspects: tuple[str, ...], corrupts: tuple[str, ...], honest: Honest, change: Change
) -> Fault:
    return Fault(f"orientation {name}", "orientation sensor", suspects, corrupts, honest, change)


ORIENTATION = (
    _about_orientation("stored xyzw", _ORDER, _TURNS, "refuse", of_orientation(stored_xyzw)),
    _about_orientation("inverted", _ORDER, _TURNS, "refuse", of_orientation(inverted)),
    _about_orientation("random", _ANY, _TURNS, "refuse", of_orientation(random_turns)),
    _about_orientation(
        "spikes of 180 deg",
        ("spike", "jump", "outlier"),
        _TURNS,
        "say",
        of_orientation(flipping, 0.05),
    ),
    _about_orientation("constant", _FROZEN, _TURNS, "say", of_orientation(held, 0.0)),
    _about_orientation("frozen from halfway", _FROZEN, _TURNS, "say", of_orientation(held, 0.5)),
    _about_orientation(
        "held for eight readings",
        _FROZEN,
        _TURNS,
        "stand",
        of_orientation(sampled_and_held, 8),
    ),
    *(
        _about_orientation(f"clock off by {late} s", _CLOCK, _TURNS, "say", clock_late("orientation", late))
        for late in (0.25, -0.25, 0.5, 1.0)
    ),
    _about_orientation("clock 10 % fast", _CLOCK, _TURNS, "stand", clock_rate("orientation", 1 / 1.1)),
    _about_orientation(
        "mirrored",
        _ORDER,
        _TURNS,
        "refuse",
        of_orientation(with_factors, [1.0, -1.0, -1.0, 1.0]),
    ),
    _about_orientation(
        "x of the other sign",
        _ORDER,
        _TURNS,
        "refuse",
        of_orientation(with_factors, [1.0, -1.0, 1.0, 1.0]),
    ),
    *(
        _about_orientation(
            f"mount turned by {degrees} deg about {axis}",
            _MOUNT,
            _TURNS,
            "say" if degrees < 90 else "refuse",
            mounted("orientation", partial(mount_turned, degrees, axis)),
        )
        for degrees in (20, 90, 180)
        for axis in "xyz"
    ),
    _about_orientation(
        "mount inverted",
        (*_MOUNT, *_ORDER),
        _TURNS,
        "refuse",
        mounted("orientation", lambda mount: mount.inv()),
    ),
    _about_orientation(
        "gyroscope in degrees",
        _UNITS,
        (),
        "stand",
        inertial("gyroscope_rad_s", float(np.rad2deg(1.0))),
    ),
    _about_orientation(
        "acceleration in g", _UNITS, (), "stand", inertial("accelerometer_m_s2", 1.0 / GRAVITY_M_S2)
    ),
    _about_orientation("of another sweep", _ANY, _TURNS, "refuse", stream_of_another),
    _about_orientation("heading drift of 5 deg/s", _ANY, _TURNS, "say", heading_drift),
    _about_orientation(
        "rounded to 0.01",
        ("round", "precision", "noise", "resol"),
        _TURNS,
        "stand",
        of_orientation(rounded, 2),
    ),
)


# --- images and curves ----------------------------------------------------------------------------------


_EVERY = ("image", "orientation", "pose")


CURVES = (
    Fault(
        "curves 10 mm deeper",
        "curves",
        (),
        _EVERY,
        "say",
        change_curves=lambda c: depths(c, lambda depth: depth + 10.0),
    ),
    Fault(
        "curves of 64 to 100 mm",
        "curves",
        (),
        _EVERY,
        "refuse",
        change_curves=lambda c: depths(c, on_64_to_100_mm),
    ),
    Fault("curves reversed in depth", "curves", (), _EVERY, "say", change_curves=upside_down),
    Fault("curves x 1.5", "curves", (), _EVERY, "say", change_curves=lambda c: stretched(c, 1.5)),
    Fault(
        "curves x 1000",
        "curves",
        (),
        _EVERY,
        "refuse",
        change_curves=lambda c: stretched(c, 1000.0),
    ),
    Fault(
        "sampled twice as fast, in both",
        "curves",
        (),
        _EVERY,
        "say",
        keyed_twice,
        lambda c: replace(c, key=replace(c.key, signal=twice(c.key.signal))),
    ),
)


IMAGES = (
    Fault(
        "resting probe, noise at 3 dB",
        "images",
        (),
        _EVERY,
        "refuse",
        lambda sweep, rng: replace(
            of_images(partial(resting, snr_db=3.0))(sweep, rng),
            truth=None if sweep.truth is None else sweep.truth[np.zeros(len(sweep), dtype=int)],
        ),
    ),
    Fault(
        "static clutter at 0 dB",
        "images",
        ("clutter", "static"),
        _EVERY,
        "say",
        of_images(clutter),
    ),
    Fault("two sweeps interleaved", "images", (), _EVERY, "refuse", in_order(interleaved)),
    Fault(
        "images left to right",
        "images",
        (),
        ("orientation", "pose", "sign"),
        "say",
        lambda sweep, rng: replace(sweep, frames=all_frames(sweep)[:, ::-1]),
    ),
    Fault(
        "frames in reverse",
        "images",
        (),
        ("orientation", "pose", "sign"),
        "say",
        in_order(lambda n: np.arange(n)[::-1]),
    ),
    Fault(
        "display frozen for a sixth",
        "images",
        (),
        _EVERY,
        "say",
        in_order(frozen_display),
    ),
    Fault("every frame twice", "images", (), (), "stand", in_order(lambda n: np.arange(n) // 2 * 2)),
)


FAULTS = (*TRACKER, *ORIENTATION, *CURVES, *IMAGES)
FAULTS_BY_NAME = {fault.name: fault for fault in FAULTS}
