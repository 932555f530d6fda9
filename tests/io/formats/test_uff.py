import h5py
import numpy as np
import pytest
from format_examples import FIRST_MM, PITCH_MM, SPACING_MM, VECTORS, axes, carrying, iq, rf, write_uff

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import RFSettings
from speckle3d.io.describe import describe
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import load_sweep

RATE = ImportSettings(frame_rate_hz=20.0)
SINGLE = 1e-6
"""What single precision keeps of a length in metres."""


def same(sweep, frames):
    return all(np.array_equal(sweep.frames[i], frames[i]) for i in range(len(frames)))


def require_grid(sweep):
    grid = sweep.grid
    assert (grid.vectors, grid.samples) == sweep.frames.shape[1:]
    assert grid.vector_pitch_mm == pytest.approx(PITCH_MM, rel=SINGLE)
    assert grid.sample_spacing_mm == pytest.approx(SPACING_MM, rel=SINGLE)
    assert grid.first_sample_depth_mm == pytest.approx(FIRST_MM, rel=SINGLE)


@pytest.mark.parametrize(("frames", "modulation"), [(iq(), 6e6), (iq(), 0.0), (rf(), 0.0)])
def test_beamformed_data_as_ustb_writes_them(tmp_path, frames, modulation):
    sweep = load_sweep(write_uff(tmp_path / "a.uff", frames, modulation), RATE)
    require_grid(sweep)
    assert same(sweep, frames)
    middle = modulation if np.iscomplexobj(frames) else None
    rate = sweep.signal.sampling_rate_hz
    assert rate == pytest.approx(1540e3 / (2 * SPACING_MM), rel=SINGLE)
    assert sweep.signal == RFSettings(rate, 1540.0, 6e6, (4.5e6, 7.5e6), middle)
    np.testing.assert_array_equal(sweep.frame_time_s, np.arange(len(frames)) / 20)
    assert (sweep.name, sweep.tracker, sweep.orientation, sweep.truth) == ("a", None, None, None)


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
    sweep = load_sweep(tmp_path / "a.uff", RATE)
    require_grid(sweep)
    assert same(sweep, frames)


def test_pyuff_agrees_on_where_pixels_lie(tmp_path):
    """Its reader and ours put the same positions to the same numbers."""
    pyuff = pytest.importorskip("pyuff_ustb")
    path = write_uff(tmp_path / "a.uff", rf())
    scan = pyuff.LinearScan(x_axis=axes()[0], z_axis=axes()[1])
    sweep = load_sweep(path, RATE)
    column, row = 4, 7
    pixel = column * sweep.grid.samples + row
    assert scan.x[pixel] == pytest.approx(axes()[0][column])
    assert scan.z[pixel] == pytest.approx(axes()[1][row])
    held = pyuff.Uff(str(path)).read("b_data").data
    assert held[2, 0, 0, pixel] == sweep.frames[2][column, row]


def test_one_frame_has_no_axis_of_frames_and_needs_no_rate(tmp_path):
    sweep = load_sweep(write_uff(tmp_path / "a.uff", rf(frames=1)))
    assert len(sweep) == 1
    assert same(sweep, rf(frames=1))


def test_what_is_missing_is_asked_for_at_once_and_told(tmp_path):
    path = write_uff(tmp_path / "a.uff", rf(), pulse=None)
    with pytest.raises(MissingSettingsError) as caught:
        load_sweep(path)
    assert caught.value.settings == ("centre_frequency_hz", "bandwidth_hz", "frame_rate_hz")
    rows = {name: value for name, value, _ in describe(path)}
    assert rows["speed of sound"] == "1540 (assumed)"
    assert rows["bandwidth"] == "missing: --bandwidth-hz"
    assert rows["first sample depth"] == "4 (in b_data/scan/z_axis)"
    assert rows["frame rate of videos made of it, not used"] == "1"
    assert rows["sweep"].startswith("none: ")


def test_an_envelope_becomes_grey_levels_and_says_so(tmp_path):
    frames = np.abs(iq())
    path = write_uff(tmp_path / "a.uff", frames)
    sweep = load_sweep(path, RATE)
    assert sweep.frames.dtype == np.uint8
    # Half a level of 80 dB is 0.16 dB.
    levels = 20 * np.log10(frames / frames.max())
    read = 80 * (np.stack([sweep.frames[i] for i in range(len(frames))]) / 255 - 1)
    np.testing.assert_allclose(read, np.maximum(levels, -80), atol=0.16)
    assert sweep.signal.dynamic_range_db == 80
    assert any("envelope" in value for _, value, _ in describe(path))


def test_images_in_decibels_become_grey_levels(tmp_path):
    frames = np.minimum(-np.abs(rf()) / 50.0, -0.5)
    sweep = load_sweep(
        write_uff(tmp_path / "a.uff", frames), ImportSettings(frame_rate_hz=9, dynamic_range_db=50)
    )
    read = 50 * (np.stack([sweep.frames[i] for i in range(len(frames))]) / 255 - 1)
    np.testing.assert_allclose(read, np.maximum(frames - frames.max(), -50), atol=0.1)


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


def test_a_sampling_rate_that_the_depths_contradict_is_refused(tmp_path):
    path = write_uff(tmp_path / "a.uff", rf())
    with pytest.raises(InvalidInputError, match=r"sampling_rate_hz: expected 1.561866e\+07 of samples"):
        load_sweep(path, RATE.model_copy(update={"sampling_rate_hz": 40e6}))
    given = RATE.model_copy(
        update={"sampling_rate_hz": 2 * 1480e3 / (4 * SPACING_MM), "speed_of_sound_m_s": 1480.0}
    )
    assert load_sweep(path, given).grid.sample_spacing_mm == pytest.approx(SPACING_MM, rel=SINGLE)


def moved(name, change):
    def put(file):
        values = change(file[name][()])
        del file[name]
        file[name] = values

    return put


def test_one_of_several_is_chosen_by_name(tmp_path):
    path = write_uff(tmp_path / "a.uff", rf())
    write_uff(path, rf(5), name="other")
    with pytest.raises(InvalidInputError, match=r"got b_data, other: say which by arrays"):
        load_sweep(path, RATE)
    (tmp_path / "a.uff.toml").write_text('frame_rate_hz = 20.0\narrays = { data = "other" }\n')
    assert same(load_sweep(path), rf(5))


def test_channel_data_and_sectors_say_what_is_needed(tmp_path):
    path = write_uff(tmp_path / "a.uff", rf(), scan="uff.sector_scan")
    with pytest.raises(InvalidInputError, match=r"expected a uff.linear_scan, got uff.sector_scan"):
        load_sweep(path, RATE)
    with h5py.File(tmp_path / "b.uff", "w") as file:
        file.create_group("channel_data").attrs["class"] = "uff.channel_data"
    with pytest.raises(InvalidInputError, match=r"got uff.channel_data: beamform"):
        load_sweep(tmp_path / "b.uff")
    assert ("object", "channel_data: uff.channel_data", "") in describe(tmp_path / "b.uff")


TAMPERED = {
    "reversed lines": (
        moved("b_data/scan/x_axis", lambda x: x[:, ::-1]),
        r"x: expected those of 6 x 40 pixels",
    ),
    "upside down": (
        lambda file: [moved(f"b_data/scan/{name}", lambda z: z[:, ::-1])(file) for name in ("z_axis", "z")],
        "expected rising positions",
    ),
    "x fastest": (
        lambda file: [
            moved(f"b_data/scan/{name}", lambda v: v.reshape(VECTORS, -1).T.reshape(1, -1))(file)
            for name in ("x", "z")
        ],
        "z fastest, got others",
    ),
    "uneven": (
        lambda file: [
            moved("b_data/scan/z_axis", lambda z: z**2)(file),
            file["b_data/scan"].pop("z"),
        ],
        "expected even steps",
    ),
    "axes of another image": (moved("b_data/scan/z_axis", lambda z: z[:, :-1]), "expected those of"),
    "several channels": (
        moved("b_data/data", lambda d: np.repeat(d, 2, axis=2)),
        r"one channel and one wave, summed, got \(MATLAB's order\) \(240, 2, 1, 4\)",
    ),
    "several waves": (moved("b_data/data", lambda d: np.repeat(d, 2, axis=1)), "one wave"),
    "no pixels": (moved("b_data/data", lambda d: d[..., :0]), "expected 240 pixels"),
    "no frames": (moved("b_data/data", lambda d: d[:0]), "expected frames"),
    "NaN": (moved("b_data/data", lambda d: np.where(d == d.max(), np.nan, d)), "expected a finite value"),
    "texts": (moved("b_data/data", lambda d: d.astype("S8")), "of numbers"),
    "NaN in axis": (moved("b_data/scan/x_axis", lambda x: x * np.nan), "expected finite"),
    "elsewhere": (
        lambda file: [
            file["b_data"].pop("data"),
            file["b_data"].__setitem__("data", h5py.ExternalLink("other.h5", "/data")),
        ],
        "another file",
    ),
}


@pytest.mark.parametrize("name", TAMPERED)
def test_what_cannot_be_is_refused_in_one_line(tmp_path, name):
    path = write_uff(tmp_path / "a.uff", rf())
    change, said = TAMPERED[name]
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(InvalidInputError, match=said) as caught:
        list(load_sweep(path, RATE).frames)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_frames_can_be_sent_to_another_process(tmp_path):
    import pickle

    sweep = load_sweep(write_uff(tmp_path / "a.uff", iq(), 6e6), RATE)
    _ = sweep.frames[0]
    sent = pickle.loads(pickle.dumps(sweep.frames))
    assert np.array_equal(sent[-1], iq()[-1])
    with pytest.raises(IndexError):
        sent[len(sweep)]
    sweep.frames.close()
    assert np.array_equal(sweep.frames[1], iq()[1])
