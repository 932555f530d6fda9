"""One sweep as RF and as I/Q: the same lengths, with curves that were measured on RF."""

import pytest

from speckle3d.core.geometry import elevational_steps
from speckle3d.simulation.receiver import received
from speckle3d.tracking import track

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rf(sweep):
    """The phantom's first 32 frames, 4 mm."""
    return sweep.part(0, 32)


@pytest.fixture(scope="module")
def length_of(curves):
    return lambda sweep: elevational_steps(track(sweep, curves).image, sweep.grid.centre_mm).sum()


@pytest.fixture(scope="module")
def length_of_rf(rf, length_of):
    return length_of(rf)


@pytest.mark.parametrize(
    ("middle_hz", "decimation"),
    [(7.5e6, None), (6.5e6, None), (7.5e6, 10)],
    ids=["centre", "off centre", "6.7 MHz for a band of 6"],
)
def test_i_and_q_give_the_lengths_of_their_rf(rf, length_of, length_of_rf, middle_hz, decimation):
    length = length_of(received(rf, None, middle_hz, decimation))
    # Both signals hold the same echoes; 16 bits and the filters' ends made 0.012 % at most on twelve sweeps.
    assert length == pytest.approx(length_of_rf, rel=2e-3)
    # 1.1 %, the worst of a phantom's sweeps of 20 mm in the documentation, over the root of a fifth of that.
    assert length == pytest.approx(elevational_steps(rf.truth, rf.grid.centre_mm).sum(), rel=0.025)
