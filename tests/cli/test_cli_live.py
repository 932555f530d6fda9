"""`speckle3d live` against a played sweep, as processes of their own."""

import re
import signal
import subprocess
import time

import numpy as np
import pytest
from commands import RF, command, free_port, read_until

import speckle3d as s3
from speckle3d.io.family.reconstructions import read_reconstruction


def start(*arguments):
    return subprocess.Popen(command(*arguments), stderr=subprocess.PIPE, text=True)


@pytest.fixture
def player(data_folder):
    """A sweep that is played once, and its port."""
    port = free_port()
    playing = start("play", data_folder / "phantom.h5", "--port", port)
    read_until(playing, "waiting for a client")
    yield port
    playing.kill()
    playing.communicate()


def waited_for(path, frames):
    """The sweep as soon as it has so many frames."""
    for _ in range(600):
        if path.exists():
            try:
                sweep = s3.load_sweep(path)
            except s3.Speckle3DError:
                sweep = None
            if sweep is not None and len(sweep) >= frames:
                return sweep
        time.sleep(0.1)
    raise AssertionError(f"no sweep of {frames} frames in {path}")


@pytest.mark.slow
def test_a_played_sweep_is_recorded_placed_and_reconstructed_as_off_line(player, data_folder, tmp_path):
    out, curves = tmp_path / "out", data_folder / "curves.h5"
    running = start(
        "live", f"127.0.0.1:{player}", "-o", out, "--curves", curves, "--transform", "ProbeToReference", *RF
    )
    waited_for(out / "sweep.h5", 96)
    time.sleep(1.0)
    running.send_signal(signal.SIGINT)
    _, err = running.communicate(timeout=300)
    assert running.returncode == 0, err
    count = re.search(r"96 frames in .*, (\d+) placed as they came", err)
    assert int(count[1]) > 0
    whole = s3.load_sweep(data_folder / "phantom.h5")
    sweep = s3.load_sweep(out / "sweep.h5")
    np.testing.assert_array_equal(sweep.frames[95], whole.frames[95])
    assert len(sweep.tracker.readings)
    poses = read_reconstruction(out / "reconstruction.h5").poses["image"]
    expected = s3.track(sweep, s3.load_curves(curves)).image
    np.testing.assert_allclose(poses.as_matrix(), expected.as_matrix(), atol=1e-9)
