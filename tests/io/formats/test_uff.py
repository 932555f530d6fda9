import h5py
import numpy as np
import pytest
from format_examples import FIRST_MM, PITCH_MM, SPACING_MM, axes, carrying, iq, rf, write_uff
from sweep_examples import frames_of, sizes_of

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import RFSettings
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep

RATE = ImportSettings(frame_rate_hz=20.0)


def require(sweep, frames):
    """The frames, on the examples' grid in what single precision keeps of a length in metres."""
    np.testing.assert_array_equal(frames_of(sweep), frames)
    expected = ImageGrid(*frames.shape[1:], PITCH_MM, SPACING_MM, FIRST_MM)
    assert sizes_of(sweep.grid) == pytest.approx(sizes_of(expected), rel=1e-6)


@pytest.mark.parametrize(("frames", "modulation"), [(iq(), 6e6), (iq(), 0.0), (rf(), 0.0)])
def test_beamformed_data_as_ustb_writes_them(tmp_path, frames, modulation):
    sweep = load_sweep(write_uff(tmp_path / "a.uff", frames, modulation), RATE)
    require(sweep, frames)
    rate = sweep.signal.sampling_rate_hz
    assert rate == pytest.approx(1540e3 / (2 * SPACING_MM), rel=1e-6)
    middle = modulation if np.iscomplexobj(frames) else None
    assert sweep.signal == RFSettings(rate, 1540.0, 6e6, (4.5e6, 7.5e6), middle)
    np.testing.assert_array_equal(sweep.frame_time_s, np.arange(len(frames)) / 20)


@pytest.mark.parametrize("frames", [iq(frames=3), rf(frames=3), iq(frames=1)])
def test_beamformed_data_as_pyuff_writes_them(tmp_path, frames):
    pyuff = pytest.importorskip("pyuff_ustb")
    x, z = axes()
    data = frames.reshape(len(frames), -1).T[:, None, None]
    data_set = pyuff.BeamformedData(
        data=data if len(frames) > 1 else data[..., 0],
        scan=pyuff.LinearScan(x_axis=x, z_axis=z),
        modulation_frequency=6e6,
        pulse=pyuff.Pulse(center_frequency=6e6, fractional_bandwidth=0.5, phase=0.0, waveform=np.ones(3)),
    )
    data_set.write(str(tmp_path / "a.uff"), "b_data")
    require(load_sweep(tmp_path / "a.uff", RATE), frames)


@pytest.mark.parametrize("carrier_hz", [0.0, 6e6])
def test_the_phase_is_believed_against_a_modulation_frequency(tmp_path, carrier_hz):
    frames = carrying(carrier_hz, sound_speed=1540.0)
    right, wrong = (0.0, 6e6) if carrier_hz else (6e6, 0.0)
    sweep = load_sweep(write_uff(tmp_path / "a.uff", frames, right), RATE)
    assert sweep.signal.demodulation_frequency_hz == right
    path = write_uff(tmp_path / "b.uff", frames, wrong)
    with pytest.warns(UserWarning, match="phase"):
        assert load_sweep(path, RATE).signal.demodulation_frequency_hz == right


def test_a_sector_scan_of_a_curved_array(tmp_path):
    frames = rf()
    path = write_uff(tmp_path / "a.uff", frames, scan="uff.sector_scan")
    angle = np.linspace(-0.2, 0.3, frames.shape[1])
    depth = 0.04 + 1e-3 * SPACING_MM * np.arange(frames.shape[2])
    # The array's face is 38 mm from where the lines meet, and its middle at z = 0.
    z = np.outer(np.cos(angle), depth).ravel() - 0.038
    with h5py.File(path, "r+") as file:
        scan = file["b_data/scan"]
        scan["azimuth_axis"], scan["depth_axis"] = angle[None], depth[None]
        scan["z"][:] = z[None]
    sweep = load_sweep(path, RATE)
    np.testing.assert_array_equal(frames_of(sweep), frames)
    assert sweep.grid.fan.radius_mm == pytest.approx(38.0, abs=1e-3)
    assert sweep.grid.first_sample_depth_mm == pytest.approx(2.0, abs=1e-3)
    np.testing.assert_allclose(sweep.grid.angle_rad([0, len(angle) - 1]), [-0.2, 0.3], atol=1e-6)
