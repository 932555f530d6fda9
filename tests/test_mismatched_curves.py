"""Curves that do not belong to the shipped sweep are refused, whichever way they are wrong."""

from dataclasses import replace

import pytest

from speckle3d.core.curves import SpeckleSize, TiltResponse
from speckle3d.core.errors import MismatchError
from speckle3d.tracking import track


@pytest.fixture(scope="module")
def part(sweep):
    """5 mm of the shipped sweep, without sensors."""
    return replace(sweep.part(0, 32), tracker=None, orientation=None)


def reverse(curves):
    """Curves reversed in depth, all that belongs to a depth with them."""
    tilt = TiltResponse(*(field[::-1].copy() for field in vars(curves.tilt).values()))
    size = SpeckleSize(*(field[::-1].copy() for field in vars(curves.speckle).values()))
    rho, cells = curves.correlation[::-1].copy(), curves.cells[::-1].copy()
    return replace(curves, correlation=rho, cells=cells, tilt=tilt, speckle=size)


def at_rate(sweep, factor):
    signal = replace(sweep.signal, sampling_rate_hz=factor * sweep.signal.sampling_rate_hz)
    grid = replace(sweep.grid, sample_spacing_mm=signal.sample_spacing_mm)
    return replace(sweep, signal=signal, grid=grid)


def test_reversed_curves_are_refused(part, curves):
    with pytest.raises(MismatchError, match="all depths"):
        track(part, reverse(curves))


def test_curves_of_other_depths_are_refused(part, curves):
    deeper = replace(curves, depth_mm=curves.depth_mm + 60.5)
    with pytest.raises(MismatchError, match=r"^phantom: .*64\.0 to 100\.2 mm, got 3\.5 to 39\.7 mm"):
        track(part, deeper)


def test_curves_and_sweep_at_another_sampling_rate_are_refused(part, curves):
    fast = at_rate(part, 2.0)
    key = replace(curves.key, signal=fast.signal)
    with pytest.raises(MismatchError, match=r"^phantom: (images: expected echoes|the curves do not match)"):
        track(fast, replace(curves, key=key))
