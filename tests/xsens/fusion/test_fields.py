"""A hand in invented magnetic fields: no heading is both confident and wrong, with VQF for comparison."""

from functools import cache

import numpy as np
import pytest
from broad import OFFLINE, ONLINE, counting, errors_deg, estimate, rms_deg
from field_scenes import scene, simulate_motion

WORSE = 1.15
"""Error over VQF's, as on the recorded trials."""

SIGMAS = 2.3
"""RMS error over RMS claimed sigma that is still honest: measured 2.0 on line, 2.3 off line."""

KINDS = [
    ("attached", 5.0, 20),
    ("attached", 30.0, 20),
    ("start", 20.0, 20),
    ("start", 30.0, 26),
    ("drift", 15.0, 20),
    ("wander", 20.0, 28),
    ("truncated", 0.25, 20),
]
"""Field, how much of it, and a seed: that of a hard one."""

WANDERING = ("drift", "wander")
"""No filter follows north by a field that turns: its error is claimed."""


@cache
def recording(kind, amount, seed):
    rng = np.random.default_rng([seed, *kind.encode()])
    return scene(simulate_motion(rng, 120.0 if kind in (*WANDERING, "start") else 60.0), kind, amount, rng)


@pytest.mark.parametrize("methods", [ONLINE, OFFLINE], ids=["on-line", "off-line"])
@pytest.mark.parametrize(("kind", "amount", "seed"), KINDS)
def test_no_heading_is_confident_and_wrong(kind, amount, seed, methods):
    log, true, moving = recording(kind, amount, seed)
    vqf_result, own = (estimate(log, method) for method in methods)
    vqf_error, error = (errors_deg(result.wxyz, true, moving)[1] for result in (vqf_result, own))
    sigma = rms_deg(own.sigma_rad[counting(true, moving), 2])
    assert error <= max(SIGMAS * sigma, WORSE * vqf_error * (kind not in WANDERING)), (
        f"{error:.2f}, claimed {sigma:.2f}, VQF {vqf_error:.2f}"
    )
