"""A simulated sweep and the Clarius package made of it reconstruct with the same errors, at 11 frames/s."""

from dataclasses import replace

import clarius_examples as examples
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from speckle3d.corrections import correct
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep
from speckle3d.pipeline import track
from speckle3d.scoring.lengths import compare_modes
from speckle3d.simulation.receiver import received

RATE_HZ = 11.0
NOISE_DEG = 0.1


def slowed(sweep):
    """The sweep at a handheld's frame rate, and its sensor at 80 Hz without a pause."""
    frame_s = np.round(300.0 + np.arange(len(sweep)) / RATE_HZ, 9)
    mounting = sweep.orientation.sensor_from_image
    image = Slerp(frame_s, sweep.truth.rotation)
    sensor = turning(image, mounting, np.round(np.arange(frame_s[0], frame_s[-1], 1 / 80), 9))
    return replace(sweep, frame_time_s=frame_s, orientation=sensor, tracker=None), image


def turning(image, mounting, times, seed=5):
    """Stream of a sensor that sits so on the probe, with noise of its own."""
    rng = np.random.default_rng(seed)
    noise = Rotation.from_rotvec(np.deg2rad(NOISE_DEG) * rng.normal(size=(times.size, 3)))
    sensor = examples.sensor_of(image(times) * mounting.inv() * noise, times, seed)
    return replace(sensor, sensor_from_image=mounting)


@pytest.mark.slow
@pytest.mark.parametrize("signal", ["rf", "iq"])
def test_a_package_reconstructs_as_the_sweep_it_was_made_from(tmp_path, sweep, curves, signal):
    plain, image = slowed(sweep)
    plain = plain if signal == "rf" else received(plain)
    first, last = plain.frame_time_s[[0, -1]]
    times = examples.bursts_s(first - 0.2, last)
    # One pause of half a second, as both public recordings have.
    times = times[(times >= first) & ((times < first + 4.0) | (times > first + 4.5))]
    mounting = plain.orientation.sensor_from_image
    recorded = replace(plain, orientation=turning(image, mounting, times))
    package = examples.write_package(tmp_path / "x.tar", recorded, packed=True)
    read = load_sweep(package, ImportSettings(probe="L7 HD3", bandwidth_hz=plain.signal.bandwidth_hz))
    # A package does not know where the sensor sits; a calibration tells.
    read = replace(read, orientation=replace(read.orientation, sensor_from_image=mounting))
    # Those in the pause, and at the ends, where there is no sample yet or any more.
    assert 4 <= np.sum(~read.orientation.covers(read.frame_time_s)) <= 9
    tracked = track(read, curves)
    # The same samples: the same path, to the rounding of the grid's numbers.
    expected = track(plain, curves).image
    np.testing.assert_allclose(tracked.image.as_matrix(), expected.as_matrix(), atol=1e-6)
    turned = correct(tracked, read, ["orientation"])["orientation"].poses
    row = compare_modes({"orientation": turned}, sweep.truth, sweep.grid.centre_mm, end_frames=1)[0]
    # Noise of the sensor of 0.1 deg, over some 20 samples, and what is bridged.
    assert abs(row.tilt_error_deg) < 0.4
