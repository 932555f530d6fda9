import pickle

import h5py
import numpy as np
import pytest
from format_examples import FIRST_MM, PITCH_MM, SPACING_MM, VECTORS, axes, carrying, iq, rf, write_uff

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import RFSettings
from speckle3d.io.describe import describe
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import import_notes, load_sweep

RATE = ImportSettings(frame_rate_hz=20.0)


def read(sweep):
    return np.stack([sweep.frames[i] for i in range(len(sweep))])


def require(sweep, frames):
    """The frames, on the examples' grid in what single precision keeps of a length in metres."""
    np.testing.assert_array_equal(read(sweep), frames)
    grid = sweep.grid
    sizes = grid.vector_pitch_mm, grid.sample_spacing_mm, grid.first_sample_depth_mm
    assert sizes == pytest.approx((PITCH_MM, SPACING_MM, FIRST_MM), rel=1e-6)


@pytest.mark.parametrize(("frames", "modulation"), [(iq(), 6e6), (iq(), 0.0), (rf(), 0.0)])
def test_beamformed_data_as_ustb_writes_them(tmp_path, frames, modulation):
    sweep = load_sweep(write_uff(tmp_path / "a.uff", frames, modulation), RATE)
    require(sweep, frames)
    rate = sweep.signal.sampling_rate_hz
    assert rate == pytest.approx(1540e3 / (2 * SPACING_MM), rel=1e-6)
    middle = modulation if np.iscomplexobj(frames) else None
    assert sweep.signal == RFSettings(rate, 1540.0, 6e6, (4.5e6, 7.5e6), middle)
    np.testing.assert_array_equal(sweep.frame_time_s, np.arange(len(frames)) / 20)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(sweep.frames))[-1], frames[-1])


@pytest.mark.parametrize("frames", [iq(frames=3), rf(frames=3), iq(frames=1)])
def test_beamformed_data_as_pyuff_writes_them(tmp_path, frames):
    pyuff = pytest.importorskip("pyuff_ustb")
    x, z = axes()
    data = frames.reshape(len(frames), -1).T[:, None, None]
    made = pyuff.BeamformedData(
        data=data if len(frames) > 1 else data[..., 0],
        scan=pyuff.LinearScan(x_axis=x, z_axis=z),
        modulation_frequency=6e6,
        pulse=pyuff.Pulse(center_frequency=6e6, fractional_bandwidth=0.5, phase=0.0, waveform=np.ones(3)),
    )
    made.write(str(tmp_path / "a.uff"), "b_data")
    require(load_sweep(tmp_path / "a.uff", RATE), frames)


def test_one_frame_has_no_axis_of_frames_and_needs_no_rate(tmp_path):
    require(load_sweep(write_uff(tmp_path / "a.uff", rf(frames=1))), rf(frames=1))


def test_what_is_missing_is_asked_for_at_once_and_told(tmp_path):
    path = write_uff(tmp_path / "a.uff", rf(), pulse=None)
    with pytest.raises(MissingSettingsError) as caught:
        load_sweep(path)
    assert caught.value.settings == ("centre_frequency_hz", "bandwidth_hz", "frame_rate_hz")
    rows = {name: value for name, value, _ in describe(path)}
    assert rows["speed of sound"] == "1540 (assumed)"
    assert rows["bandwidth"] == "missing: --bandwidth-hz"
    assert rows["first sample depth"] == "4 (in b_data/scan/z_axis)"
    assert rows["sweep"].startswith("none: ")


@pytest.mark.parametrize("decibels", [False, True])
def test_data_of_one_sign_become_grey_levels(tmp_path, decibels):
    frames = np.minimum(-np.abs(rf()) / 50.0, -0.5) if decibels else np.abs(iq())
    sweep = load_sweep(write_uff(tmp_path / "a.uff", frames), RATE)
    levels = frames - frames.max() if decibels else 20 * np.log10(frames / frames.max())
    # Half a level of 80 dB is 0.16 dB.
    np.testing.assert_allclose(80 * (read(sweep) / 255 - 1), np.maximum(levels, -80), atol=0.16)
    assert sweep.signal.dynamic_range_db == 80


@pytest.mark.parametrize("carried", [0.0, 6e6])
def test_a_modulation_frequency_that_the_phase_contradicts_is_refused(tmp_path, carried):
    frames = carrying(carried, sound_speed=1540.0)
    right, wrong = (0.0, 6e6) if carried else (6e6, 0.0)
    sweep = load_sweep(write_uff(tmp_path / "a.uff", frames, right), RATE)
    assert sweep.signal.demodulation_frequency_hz == right
    path = write_uff(tmp_path / "b.uff", frames, wrong)
    with pytest.raises(InvalidInputError, match="as their phase tells"):
        load_sweep(path, RATE)
    given = RATE.model_copy(update={"demodulation_frequency_hz": right})
    assert load_sweep(path, given).signal.demodulation_frequency_hz == right


def test_a_sampling_rate_that_the_depths_contradict_is_told(tmp_path):
    path = write_uff(tmp_path / "a.uff", rf())
    given = RATE.model_copy(update={"sampling_rate_hz": 40e6})
    assert any(
        "sampling rate 40 MHz, given: the file says 15.6" in note for note in import_notes(path, given)
    )


def test_one_of_several_is_chosen_by_name(tmp_path):
    path = write_uff(tmp_path / "a.uff", rf())
    write_uff(path, rf(5), name="other")
    with pytest.raises(InvalidInputError, match=r"got b_data, other: say which by arrays"):
        load_sweep(path, RATE)
    (tmp_path / "a.uff.toml").write_text('frame_rate_hz = 20.0\narrays = { data = "other" }\n')
    require(load_sweep(path), rf(5))


def test_channel_data_and_sectors_say_what_is_needed(tmp_path):
    path = write_uff(tmp_path / "a.uff", rf(), scan="uff.sector_scan")
    with pytest.raises(InvalidInputError, match=r"expected a uff.linear_scan, got uff.sector_scan"):
        load_sweep(path, RATE)
    with h5py.File(tmp_path / "b.uff", "w") as file:
        file.create_group("channel_data").attrs["class"] = "uff.channel_data"
    with pytest.raises(InvalidInputError, match=r"got uff.channel_data: beamform"):
        load_sweep(tmp_path / "b.uff")
    assert ("object", "channel_data: uff.channel_data", "") in describe(tmp_path / "b.uff")


def changed(name, change):
    def put(file):
        values = change(file[f"b_data/{name}"][()])
        del file[f"b_data/{name}"]
        file[f"b_data/{name}"] = values

    return put


def x_fastest(file):
    for name in ("x", "z"):
        changed(f"scan/{name}", lambda v: v.reshape(VECTORS, -1).T.reshape(1, -1))(file)


def upside_down(file):
    for name in ("z_axis", "z"):
        changed(f"scan/{name}", lambda z: z[:, ::-1])(file)


def uneven(file):
    changed("scan/z_axis", lambda z: z**2)(file)
    del file["b_data/scan/z"]


def elsewhere(file):
    del file["b_data/data"]
    file["b_data/data"] = h5py.ExternalLink("other.h5", "/data")


def never_written(file):
    pixels = file["b_data/data"].shape[-1]
    del file["b_data/data"]
    file.create_dataset("b_data/data", shape=(3 * 10**6, 1, 1, pixels), dtype="f4", chunks=(1, 1, 1, pixels))


@pytest.mark.parametrize(
    "change",
    [
        changed("scan/x_axis", lambda x: x[:, ::-1]),
        changed("scan/z_axis", lambda z: z[:, :-1]),
        changed("scan/x_axis", lambda x: x * np.nan),
        changed("data", lambda d: np.repeat(d, 2, axis=2)),
        changed("data", lambda d: np.repeat(d, 2, axis=1)),
        changed("data", lambda d: d[:0]),
        changed("data", lambda d: np.where(d == d.max(), np.nan, d)),
        changed("data", lambda d: d.astype("S8")),
        x_fastest,
        upside_down,
        uneven,
        elsewhere,
        never_written,
    ],
)
def test_what_cannot_be_is_refused_in_one_line(tmp_path, change):
    path = write_uff(tmp_path / "a.uff", rf())
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(InvalidInputError) as caught:
        list(load_sweep(path, RATE).frames)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
