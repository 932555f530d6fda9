"""What is received written down on one clock."""

from types import SimpleNamespace

import numpy as np
import pytest
from sweep_examples import RF

import speckle3d as s3
from speckle3d.core.grid import ImageGrid
from speckle3d.io.family.sweep_writer import GrowingSweep
from speckle3d.live import recording
from speckle3d.live.progress import Progress
from speckle3d.live.recording import SweepRecorder


@pytest.fixture
def record(tmp_path, monkeypatch):
    """Records frames that come at some times here, with some times of the sender's; the sweep's times."""

    def times_of(here_s, sent_s):
        frame = np.ones((4, 8), dtype=np.int16)
        grid, progress = ImageGrid(4, 8, 0.3, RF.sample_spacing_mm), Progress()
        clock = iter([here_s[0], *here_s])
        monkeypatch.setattr(recording, "time", SimpleNamespace(monotonic=lambda: next(clock)))
        with GrowingSweep(tmp_path / "sweep.h5", grid, RF, frame.dtype) as sweep:
            growing = SweepRecorder(sweep, sent_s[0], progress)
            for time_s in sent_s:
                growing.keep_frame(frame, time_s)
        return s3.load_sweep(tmp_path / "sweep.h5").frame_time_s, progress

    return times_of


@pytest.mark.parametrize(
    ("here_s", "sent_s", "expected_s", "restarts", "refusals"),
    [
        ([0.0, 0.3, 0.31], [50.0, 50.04, 50.08], [0.0, 0.04, 0.08], 0, 0),
        ([0.0, 0.04, 2.0, 2.04], [50.0, 50.04, 3.0, 3.04], [0.0, 0.04, 2.0, 2.04], 1, 0),
        ([7.0, 7.05, 7.09], [0.0, 0.0, 0.0], [0.0, 0.05, 0.09], 0, 0),
        ([0.0, 0.04, 0.08], [50.0, 50.04, 50.03], [0.0, 0.04], 0, 1),
    ],
    ids=["the sender's", "a clock that begins anew", "messages without a time", "a little before the last"],
)
def test_times_are_the_senders_or_what_passed_here(record, here_s, sent_s, expected_s, restarts, refusals):
    times, counts = record(here_s, sent_s)
    np.testing.assert_allclose(times, expected_s, atol=1e-9)
    assert (counts.restarts, counts.refusals) == (restarts, refusals)
