"""A sweep served by the command, received by a client."""

import subprocess
import time
from contextlib import contextmanager

import numpy as np
import pytest
import sweep_examples
from commands import command

from speckle3d.io.igtl.link import Connection
from speckle3d.io.igtl.messages import ImageReceived
from speckle3d.io.sweep_writer import write_sweep

WAIT_S = 60.0


@contextmanager
def served(*arguments):
    """Start the command at any free port; yields its process and the port that it told."""
    with subprocess.Popen(
        command("play", *arguments, "--port", 0), stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    ) as process:
        try:
            said = process.stderr.readline()
            yield process, int(said.split(":")[1])
        finally:
            process.kill()


def received(port, enough):
    """All messages until there are `enough` images, and the times at which these came."""
    found, came, images = [], [], 0
    with Connection("127.0.0.1", port) as connection:
        end = time.monotonic() + WAIT_S
        while images < enough and time.monotonic() < end:
            for each in connection.receive(0.1):
                found.append(each)
                if isinstance(each, ImageReceived):
                    images += 1
                    came.append(time.monotonic())
        assert connection.state.refused == 0
    return found, came


@pytest.mark.slow
def test_a_recorded_sweep_is_served_whole_and_at_its_own_rate(tmp_path):
    sweep = sweep_examples.rf_sweep(frames=26)
    write_sweep(tmp_path / "s.h5", sweep)
    with served(tmp_path / "s.h5") as (process, port):
        found, came = received(port, 26)
        assert process.wait(WAIT_S) == 0
    frames = [each for each in found if isinstance(each, ImageReceived)]
    np.testing.assert_array_equal([each.pixels.T for each in frames], sweep.frames)
    # Half a nanosecond: the clock of messages counts 2^-32 s.
    np.testing.assert_allclose([each.time_s for each in frames], sweep.frame_time_s, atol=5e-10)
    np.testing.assert_allclose(frames[0].spacing_mm[:2], [sweep.grid.sample_spacing_mm, 0.3], rtol=1e-6)
    # Frames do not come early; that they are late now and then is the machine's.
    assert came[-1] - came[0] > 0.9 * (sweep.frame_time_s[-1] - sweep.frame_time_s[0])
    for name, sensor in (("ProbeToReference", sweep.tracker), ("ProbeToWorld", sweep.orientation)):
        readings = [each for each in found if each.device == name]
        # Those after the last frame may come after the client has left.
        times = sensor.readings.time_s[: len(readings)]
        assert len(readings) > 70
        np.testing.assert_allclose([each.time_s for each in readings], times, atol=5e-10)
        turns = sensor.readings.world_from_sensor[: len(readings)].as_matrix()[:, :3, :3]
        # 1e-6: single precision.
        np.testing.assert_allclose([each.matrix[:3, :3] for each in readings], turns, atol=1e-6)
    place = sweep.tracker.world_from_image(sweep.frame_time_s[9]).as_matrix()
    corner = place @ [*sweep.grid.corners_mm[2], 1.0]
    np.testing.assert_allclose(frames[9].image_to_world @ [39.0, 4.0, 0.0, 1.0], corner, atol=1e-5)
