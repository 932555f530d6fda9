import h5py
import numpy as np
import pytest
from format_examples import (
    FIRST_MM,
    FRAMES,
    PITCH_MM,
    SAMPLES,
    SPACING_MM,
    VECTORS,
    carrying,
    grey,
    iq,
    rf,
    write_zea,
)  # fmt: skip
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings, ImageGrid, RFSettings
from speckle3d.io.describe import describe
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import load_sweep, open_recording

BAND = (4.5e6, 7e6)
GIVEN = ImportSettings(bandwidth_hz=BAND, frame_rate_hz=20.0)
SINGLE = 1e-6
"""What single precision keeps of a length in metres."""


def read(sweep):
    return np.stack([sweep.frames[i] for i in range(len(sweep))])


def require_grid(grid):
    assert (grid.vectors, grid.samples) == (VECTORS, SAMPLES)
    assert grid.vector_pitch_mm == pytest.approx(PITCH_MM, rel=SINGLE)
    assert grid.sample_spacing_mm == pytest.approx(SPACING_MM, rel=SINGLE)
    assert grid.first_sample_depth_mm == pytest.approx(FIRST_MM, rel=SINGLE)


def test_rf_with_coordinates(tmp_path):
    between = np.full((FRAMES, 3), 0.01)
    between[1] = 0.02
    path = write_zea(
        tmp_path / "a.hdf5", rf(), scan={"time_to_next_transmit": between, "bandwidth_percent": 50}
    )
    sweep = load_sweep(path)
    np.testing.assert_array_equal(read(sweep), rf())
    require_grid(sweep.grid)
    rate = sweep.signal.sampling_rate_hz
    assert rate == pytest.approx(1480e3 / (2 * SPACING_MM), rel=SINGLE)
    assert sweep.signal == RFSettings(rate, 1480.0, 6e6, (4.5e6, 7.5e6))
    np.testing.assert_allclose(sweep.frame_time_s, [0, 0.03, 0.09, 0.12], rtol=1e-6)
    assert (sweep.probe, sweep.name) == ("L11-4v", "a")


@pytest.mark.parametrize(("carried", "middle"), [(0.0, 6e6), (6e6, 0.0)])
def test_iq_that_carry_their_frequency_or_do_not_are_told_by_their_phase(tmp_path, carried, middle):
    frames = carrying(carried)
    sweep = load_sweep(write_zea(tmp_path / "a.hdf5", frames), GIVEN)
    np.testing.assert_array_equal(read(sweep), frames)
    assert sweep.signal.demodulation_frequency_hz == middle


def test_iq_of_the_other_sign_are_refused_and_noise_is_asked_about(tmp_path):
    with pytest.raises(InvalidInputError, match="Q has the other sign"):
        load_sweep(write_zea(tmp_path / "a.hdf5", np.conj(carrying(6e6))), GIVEN)
    with pytest.raises(MissingSettingsError) as caught:
        load_sweep(write_zea(tmp_path / "b.hdf5", iq()), GIVEN)
    assert caught.value.settings == ("demodulation_frequency_hz",)
    given = GIVEN.model_copy(update={"demodulation_frequency_hz": 6e6})
    np.testing.assert_array_equal(read(load_sweep(tmp_path / "b.hdf5", given)), iq())


def test_files_without_coordinates_ask_for_where_lines_are(tmp_path):
    path = write_zea(tmp_path / "a.hdf5", rf(), placed=False)
    with pytest.raises(MissingSettingsError) as caught:
        load_sweep(path)
    missing = ("vector_pitch_mm", "sampling_rate_hz", "bandwidth_hz", "frame_rate_hz")
    assert caught.value.settings == missing
    given = GIVEN.model_copy(update={"vector_pitch_mm": 0.2, "sampling_rate_hz": 20e6})
    sweep = load_sweep(path, given)
    np.testing.assert_array_equal(read(sweep), rf())
    assert sweep.grid == ImageGrid(VECTORS, SAMPLES, 0.2, 0.037, 0.0)


def test_grey_levels_of_a_track(tmp_path):
    path = write_zea(tmp_path / "a.hdf5", grey(), "image", home="tracks/track_1/")
    write_zea(path, rf(), "raw_data", home="tracks/track_0/")
    sweep = load_sweep(path, ImportSettings(dynamic_range_db=60.0, frame_rate_hz=20.0))
    np.testing.assert_array_equal(read(sweep), grey())
    require_grid(sweep.grid)
    assert sweep.signal == BModeSettings(60.0)


@pytest.mark.parametrize("decibels", [False, True])
def test_amplitudes_and_decibels_become_grey_levels(tmp_path, decibels):
    amplitude = np.abs(iq())
    amplitude[0, 0, 0] = 0.0
    with np.errstate(divide="ignore"):
        levels = 20 * np.log10(amplitude / amplitude.max())
    kind = "image" if decibels else "envelope_data"
    path = write_zea(tmp_path / "a.hdf5", (levels if decibels else amplitude).astype("f4"), kind)
    sweep = load_sweep(path, ImportSettings(frame_rate_hz=20.0))
    # Half a level of 80 dB is 0.16 dB.
    np.testing.assert_allclose(80 * (read(sweep) / 255 - 1), np.maximum(levels, -80), atol=0.16)
    assert sweep.signal == BModeSettings(80.0)


def test_the_earliest_product_is_read_unless_another_is_named(tmp_path):
    path = write_zea(tmp_path / "a.hdf5", rf())
    write_zea(
        path,
        grey(),
        "image",
        scan={"sound_speed": None, "center_frequency": None, "demodulation_frequency": None},
    )
    assert load_sweep(path, GIVEN).frames.dtype == np.float32
    given = ImportSettings(dynamic_range_db=60.0, frame_rate_hz=9.0, arrays={"data": "data/image"})
    np.testing.assert_array_equal(read(load_sweep(path, given)), grey())


def test_two_tracks_are_not_chosen_from(tmp_path):
    path = write_zea(tmp_path / "a.hdf5", rf(), home="tracks/a/")
    write_zea(path, rf(3), home="tracks/b/")
    with pytest.raises(InvalidInputError, match=r"expected one track, got tracks/a/.*say which by arrays"):
        load_sweep(path, GIVEN)
    given = GIVEN.model_copy(update={"arrays": {"data": "tracks/b/data/beamformed_data"}})
    np.testing.assert_array_equal(read(load_sweep(path, given)), rf(3))


def test_channel_data_are_told_and_say_what_they_need(tmp_path):
    path = write_zea(tmp_path / "a.hdf5", rf(), "raw_data")
    with pytest.raises(InvalidInputError, match="channel data need beamforming"):
        load_sweep(path)
    rows = {name: value for name, value, _ in describe(path)}
    assert rows["format"] == "zea"
    assert rows["sweep"].startswith("none: ")


def polar():
    r, angle = np.linspace(0.01, 0.03, SAMPLES)[:, None], np.linspace(-0.5, 0.5, VECTORS)
    return np.stack([r * np.sin(angle), 0 * r * angle, r * np.cos(angle)], axis=-1)


def mirrored():
    x, z = 1e-3 * np.arange(VECTORS)[::-1], 1e-3 * np.arange(1, SAMPLES + 1)[:, None]
    return np.stack([*np.broadcast_arrays(x, 0.0, z)], axis=-1)


@pytest.mark.parametrize(
    ("positions", "said"), [(polar, "as of a polar image"), (mirrored, "expected rising")]
)
def test_pixels_on_no_even_grid_are_refused(tmp_path, positions, said):
    with pytest.raises(InvalidInputError, match=said):
        load_sweep(write_zea(tmp_path / "a.hdf5", rf(), positions=positions()), GIVEN)


def test_axes_are_told_by_the_coordinates_and_not_by_their_order(tmp_path):
    """An image written lateral axis first, as one version of the format has it."""
    path = write_zea(tmp_path / "a.hdf5", rf())
    with h5py.File(path, "r+") as file:
        group = file["data/beamformed_data"]
        for name in ("values", "coordinates"):
            turned = group[name][()].transpose(0, 2, 1, 3)
            del group[name]
            group[name] = turned
    sweep = load_sweep(path, GIVEN)
    np.testing.assert_array_equal(read(sweep), rf())
    require_grid(sweep.grid)


def changed(name, change):
    def put(file):
        values = change(file[name][()])
        del file[name]
        file[name] = values

    return put


VALUES, PLACES = "data/beamformed_data/values", "data/beamformed_data/coordinates"
TAMPERED = {
    "three channels": (changed(VALUES, lambda v: np.repeat(v, 3, axis=3)), "expected echoes of shape"),
    "a volume": (changed(VALUES, lambda v: v[..., None]), "expected echoes of shape"),
    "no frames": (changed(VALUES, lambda v: v[:0]), "expected echoes of shape"),
    "other pixels": (changed(VALUES, lambda v: v[:, :-1]), "expected shape"),
    "NaN": (changed(VALUES, lambda v: np.where(v == v.max(), np.nan, v)), "expected a finite value"),
    "NaN in places": (
        changed(PLACES, lambda v: np.where(v == v.max(), np.nan, v)),
        "expected pixels",
    ),
    "a moving grid": (
        changed(PLACES, lambda v: v + 1e-3 * np.arange(4)[:, None, None, None]),
        "first frame's are",
    ),
    "elsewhere": (
        lambda file: [file.pop(VALUES), file.__setitem__(VALUES, h5py.ExternalLink("other.h5", "/v"))],
        "another file",
    ),
    "two frequencies": (changed("scan/center_frequency", lambda v: [6e6, 7e6]), "expected one number"),
    "times": (
        lambda file: file["scan"].__setitem__("time_to_next_transmit", np.zeros((FRAMES, 2))),
        "expected times above 0",
    ),
    "pixels with an extent": (
        lambda file: [file.pop(PLACES), file["data/beamformed_data"].move("values", "pixels")],
        "whose axes are not certain",
    ),
}


@pytest.mark.parametrize("name", TAMPERED)
def test_what_cannot_be_is_refused_in_one_line(tmp_path, name):
    path = write_zea(tmp_path / "a.hdf5", rf())
    change, said = TAMPERED[name]
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(InvalidInputError, match=said) as caught:
        read(
            load_sweep(
                path, ImportSettings(bandwidth_hz=BAND, frame_rate_hz=None if name == "times" else 20.0)
            )
        )
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("kind", ["quaternion_wxyz", "quaternion_xyzw", "euler_xyz"])
def test_probe_poses_are_the_tracker(tmp_path, kind):
    """As zea 0.1.8 writes them: of the transducer's tip, in metres, y elevational and z axial."""
    places = np.array([[0.0, 1e-4 * i, 0.0] for i in range(10)])
    turns = Rotation.from_rotvec(0.01 * np.arange(10)[:, None] * [0.0, 0.0, 1.0])
    rotation = {
        "quaternion_wxyz": turns.as_quat(scalar_first=True),
        "quaternion_xyzw": turns.as_quat(),
        "euler_xyz": turns.as_euler("xyz"),
    }[kind]
    path = write_zea(
        tmp_path / "a.h5", grey(), "image", scan={"time_to_next_transmit": np.full((4, 2), 0.05)}
    )
    places[3] = np.nan  # a lost pose
    with h5py.File(path, "a") as file:
        group = file.create_group("metadata/probe_pose")
        group["translation"], group["rotation"] = places.astype("f4"), rotation.astype("f4")
        group["rotation_representation"] = kind
        group["start_time_offset"], group["sampling_frequency"] = np.float32(-0.1), np.float32(20.0)
    recording = open_recording(path, ImportSettings(dynamic_range_db=60.0))
    sweep = recording.sweep
    np.testing.assert_allclose(
        sweep.tracker.readings.time_s, -0.1 + 0.05 * np.delete(np.arange(10), 3), atol=1e-6
    )
    image = sweep.tracker.world_from_image(sweep.frame_time_s)
    # A step along zea's y is one against the image's normal.
    np.testing.assert_allclose(np.diff(image.translation[:, 1]), 0.2, atol=0.02)
    np.testing.assert_allclose(
        image[0].rotation.as_matrix()[:, 2], [np.sin(0.02), -np.cos(0.02), 0], atol=1e-5
    )
    left_mm = np.linalg.norm(sweep.tracker.sensor_from_image.translation)
    assert left_mm == pytest.approx(PITCH_MM * (VECTORS - 1) / 2, abs=1e-6)
    assert any("1 of 10 left out" in note for note in recording.notes)
    assert any(note.startswith("poses of metadata/probe_pose") for note in recording.notes)
