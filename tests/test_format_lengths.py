"""A sweep reconstructs the same from whatever format it comes in."""

from dataclasses import replace

import numpy as np
import pytest
from format_examples import matlab_order, write_dicom, write_mat, write_uff, write_ultrasonix, write_zea
from scipy.signal import hilbert

from speckle3d.core.geometry import elevational_steps
from speckle3d.io.curves import read_curves
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep
from speckle3d.pipeline import track
from speckle3d.simulation.presets import SimulationSettings, simulate
from speckle3d.simulation.receiver import received_as_bmode

pytestmark = pytest.mark.slow

SETTINGS = SimulationSettings(preset="tissue", vectors=26, samples=1000, seed=5, length_mm=1.5, frames=12)


@pytest.fixture(scope="module")
def simulated():
    return simulate(SETTINGS)[0].sweep


@pytest.fixture(scope="module")
def length(shipped):
    curves = read_curves(shipped / "curves.h5")

    def measured(sweep):
        return abs(elevational_steps(track(sweep, curves).image, sweep.grid.centre_mm).sum())

    return measured


@pytest.fixture(scope="module")
def expected(simulated, length):
    return length(simulated)


def frames_of(sweep):
    return np.stack([sweep.frames[i] for i in range(len(sweep))])


def of_signal(signal, sweep, **more):
    rate = (len(sweep) - 1) / float(np.ptp(sweep.frame_time_s))
    return ImportSettings(bandwidth_hz=signal.bandwidth_hz, frame_rate_hz=rate, **more)


def test_rf_in_every_format(tmp_path, simulated, length, expected):
    signal, grid, rf = simulated.signal, simulated.grid, frames_of(simulated)
    centre, pitch = signal.centre_frequency_hz, grid.vector_pitch_mm
    given = of_signal(signal, simulated)
    plain = {"vector_pitch_mm": pitch, "first_sample_depth_mm": grid.first_sample_depth_mm}
    numbers = plain | {"sampling_rate_hz": signal.sampling_rate_hz, "centre_frequency_hz": centre}
    arrays = {"rf": "data", "axes": "sample, vector, frame"}
    rate, transmitted = round(signal.sampling_rate_hz), round(centre)
    scan = {
        "sound_speed": signal.speed_of_sound_m_s,
        "center_frequency": centre,
        "demodulation_frequency": centre,
    }
    written = {
        write_uff(tmp_path / "a.uff", rf, pulse=(centre, 0.5), grid=grid): given,
        write_zea(tmp_path / "a.hdf5", rf, grid=grid, scan=scan): given,
        write_mat(tmp_path / "old.mat", False, data=matlab_order(rf)): of_signal(
            signal, simulated, arrays=arrays, **numbers
        ),
        write_mat(tmp_path / "new.mat", True, data=matlab_order(rf)): of_signal(
            signal, simulated, arrays=arrays, **numbers
        ),
        write_ultrasonix(tmp_path / "a.rf", rf, sampling_hz=rate, transmit_hz=transmitted): of_signal(
            signal, simulated, **plain
        ),
    }
    for path, settings in written.items():
        sweep = load_sweep(path, settings)
        np.testing.assert_array_equal(frames_of(sweep), rf)
        # Lengths in metres of single precision, frequencies in whole Hz: 1e-6 of either.
        assert length(sweep) == pytest.approx(expected, rel=1e-4), path.name


@pytest.mark.parametrize("carries", [False, True])
def test_iq_in_zea_and_ustb_whose_carrier_the_phase_tells(tmp_path, simulated, length, carries):
    centre = simulated.signal.centre_frequency_hz
    signal, grid = simulated.signal, simulated.grid
    grid = replace(grid, samples=grid.samples // 2, sample_spacing_mm=2 * grid.sample_spacing_mm)
    iq = hilbert(frames_of(simulated), axis=2)[..., ::2]
    if not carries:
        depth_mm = grid.first_sample_depth_mm + grid.sample_spacing_mm * np.arange(grid.samples)
        iq = iq * np.exp(-2j * np.pi * 2e-3 * depth_mm * centre / signal.speed_of_sound_m_s)
    iq = iq.astype(np.complex64)
    middle = 0.0 if carries else centre
    coarse = replace(signal, sampling_rate_hz=signal.sampling_rate_hz / 2, demodulation_frequency_hz=middle)
    expected = length(replace(simulated, frames=iq, grid=grid, signal=coarse))
    given = of_signal(signal, simulated)
    scan = {
        "sound_speed": signal.speed_of_sound_m_s,
        "center_frequency": centre,
        "demodulation_frequency": centre,
    }
    for path in (
        write_zea(tmp_path / "a.hdf5", iq, grid=grid, scan=scan),
        write_uff(tmp_path / "a.uff", iq, middle, pulse=(centre, 0.5), grid=grid),
    ):
        sweep = load_sweep(path, given)
        assert sweep.signal.demodulation_frequency_hz == pytest.approx(middle, rel=1e-6)
        assert length(sweep) == pytest.approx(expected, rel=1e-4), path.name


def test_images_in_dicom(tmp_path, simulated):
    image = received_as_bmode(simulated, 60.0)
    shown = np.ascontiguousarray(frames_of(image).transpose(0, 2, 1))
    steps = [0.0, *(round(step, 9) for step in 1e3 * np.diff(image.frame_time_s))]
    spacing = [round(image.grid.sample_spacing_mm, 12), image.grid.vector_pitch_mm]
    path = write_dicom(tmp_path / "a.dcm", shown, FrameTime=None, FrameTimeVector=steps, PixelSpacing=spacing)
    first = image.grid.first_sample_depth_mm
    sweep = load_sweep(path, ImportSettings(dynamic_range_db=60.0, first_sample_depth_mm=first))
    np.testing.assert_array_equal(frames_of(sweep), frames_of(image))
    assert sweep.signal == image.signal
    # DICOM writes numbers with up to 16 letters.
    read, made = (list(vars(each.grid).values())[:-1] for each in (sweep, image))
    np.testing.assert_allclose(read, made, rtol=1e-9)
    times = image.frame_time_s - image.frame_time_s[0]
    np.testing.assert_allclose(sweep.frame_time_s, times, atol=1e-9)
