"""Arrays, pictures and video, and what has to be told of them."""

import numpy as np
import pytest
from PIL import Image
from sweep_examples import frames_of

import speckle3d
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import RFSettings
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import load_sweep

GREY = np.arange(12 * 9 * 7, dtype=np.uint8).reshape(12, 9, 7)
PIXELS = {"column_pitch_mm": 0.2, "row_spacing_mm": 0.1, "dynamic_range_db": 60.0}
RF = RFSettings(40e6, 1540.0, 5e6, (3e6, 7e6))


def test_arrays_make_a_sweep(tmp_path):
    sweep = speckle3d.Sweep.from_arrays(
        GREY, pitch_mm=(0.2, 0.1), frame_rate_hz=20.0, dynamic_range_db=60.0, first_row_depth_mm=2.0
    )
    np.testing.assert_array_equal(frames_of(sweep), GREY.transpose(0, 2, 1))
    grid = sweep.grid
    assert (grid.vector_pitch_mm, grid.sample_spacing_mm, grid.first_sample_depth_mm) == (0.2, 0.1, 2.0)
    np.testing.assert_allclose(sweep.frame_time_s, np.arange(12) / 20)
    times, echoes = np.arange(12) ** 1.1, GREY.astype(np.int16)
    sweep = speckle3d.Sweep.from_arrays(echoes, pitch_mm=0.3, frame_time_s=times, signal=RF)
    assert sweep.grid.sample_spacing_mm == pytest.approx(0.01925)
    np.testing.assert_array_equal(sweep.frame_time_s, times)


def test_an_array_file_is_read(tmp_path):
    np.save(tmp_path / "grey.npy", GREY)
    with pytest.raises(MissingSettingsError) as error:
        load_sweep(tmp_path / "grey.npy")
    assert set(error.value.settings) == {*PIXELS, "frame_rate_hz"}
    sweep = load_sweep(tmp_path / "grey.npy", ImportSettings(**PIXELS, frame_rate_hz=20))
    np.testing.assert_array_equal(frames_of(sweep), GREY.transpose(0, 2, 1))
    np.savez(tmp_path / "grey.npz", time=np.arange(12), images=GREY)
    packed = load_sweep(tmp_path / "grey.npz", ImportSettings(**PIXELS, frame_rate_hz=20))
    np.testing.assert_array_equal(frames_of(packed), frames_of(sweep))
    np.save(tmp_path / "rf.npy", GREY.astype(np.int16))
    names = ("sampling_rate_hz", "centre_frequency_hz", "bandwidth_hz")
    echoes = {name: getattr(RF, name) for name in names}
    settings = ImportSettings(vector_pitch_mm=0.3, frame_rate_hz=20, **echoes)
    assert load_sweep(tmp_path / "rf.npy", settings).signal == RF


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_folder_of_pictures_is_read_in_the_order_of_its_numbers(tmp_path, suffix):
    flat = np.repeat(np.arange(0, 240, 20, dtype=np.uint8), 9 * 7).reshape(12, 9, 7)
    for i, image in enumerate(flat):
        colour = np.stack([image] * 3, axis=-1) if suffix == ".jpg" else image
        Image.fromarray(colour).save(tmp_path / f"frame{i}{suffix}")
    settings = ImportSettings(**PIXELS, frame_rate_hz=20)
    # JPEG keeps a flat picture to a level or two.
    np.testing.assert_allclose(
        frames_of(load_sweep(tmp_path, settings)).astype(int), flat.transpose(0, 2, 1), atol=2
    )
    assert load_sweep(tmp_path, settings).frames[2:4].shape == (2, 7, 9)
    Image.fromarray(flat[0, :, :4]).save(tmp_path / f"frame12{suffix}")
    with pytest.raises(InvalidInputError, match="frame 12: expected shape"):
        frames_of(load_sweep(tmp_path, settings))


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_video_says_its_rate(tmp_path, suffix):
    iio = pytest.importorskip("imageio.v3")
    images = np.repeat(np.array([0, 60, 120, 180], np.uint8), 32 * 48 * 3).reshape(4, 32, 48, 3)
    path = tmp_path / f"v{suffix}"
    if suffix == ".gif":
        iio.imwrite(path, images[..., 0], duration=50)
    else:
        pytest.importorskip("av")
        iio.imwrite(path, images, fps=20, codec="mpeg4", plugin="pyav")
    sweep = load_sweep(path, ImportSettings(**PIXELS))
    assert sweep.frames.shape == (4, 48, 32)
    for i in (0, 1, 2, 3, 1, 0):
        # Of packing with loss.
        assert abs(int(sweep.frames[i][0, 0]) - 60 * i) <= 3
    np.testing.assert_allclose(sweep.frame_time_s, np.arange(4) / 20)
