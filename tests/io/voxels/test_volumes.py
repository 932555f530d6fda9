import numpy as np
import pytest
import SimpleITK
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.volume import Volume
from speckle3d.io.voxels.volume_writer import SUFFIXES, VolumeWriter
from speckle3d.io.voxels.volumes import read_volume, write_volume


def example(dtype=np.uint8, seed=0):
    rng = np.random.default_rng(seed)
    voxels = rng.integers(0, 256, (4, 5, 6)).astype(dtype)
    pose = RigidTransform.from_components(rng.normal(0, 50, 3), Rotation.random(rng=rng))
    return Volume(voxels, (0.5, 0.25, 1.0), pose)


@settings(deadline=None, max_examples=15)
@given(
    suffix=st.sampled_from(SUFFIXES),
    dtype=st.sampled_from([np.uint8, np.int16, np.uint16, np.float32]),
    compress=st.booleans(),
    seed=st.integers(0, 99),
)
def test_voxels_and_their_place_come_back(tmp_path_factory, suffix, dtype, compress, seed):
    path = tmp_path_factory.mktemp("volume") / f"v{suffix}"
    volume = example(dtype, seed)
    write_volume(path, volume, compress)
    got = read_volume(path)
    np.testing.assert_array_equal(got.voxels, volume.voxels)
    assert got.voxels.dtype == volume.voxels.dtype
    # NIfTI keeps its matrix in single precision: 1e-7 of 150 mm, and of a rotation.
    np.testing.assert_allclose(got.world_from_index, volume.world_from_index, atol=1e-4)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_another_reader_finds_a_voxel_where_we_say_it_is(tmp_path):
    volume = example()
    write_volume(tmp_path / "v.nrrd", volume)
    image = SimpleITK.ReadImage(str(tmp_path / "v.nrrd"))
    assert image.GetPixel(1, 2, 5) == volume.voxels[1, 2, 5]
    place = (volume.world_from_index @ [1, 2, 5, 1])[:3]
    np.testing.assert_allclose(image.TransformIndexToPhysicalPoint((1, 2, 5)), place, atol=1e-9)


def test_an_unknown_suffix_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match=r"v\.png"):
        write_volume(tmp_path / "v.png", example())


def interrupted(path, volume):
    with VolumeWriter(path, volume.shape, (1, 1, 1), volume.world_from_grid, volume.voxels.dtype) as writer:
        writer.append(volume.voxels.T[:2])
        raise KeyboardInterrupt


def test_an_interrupted_write_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        interrupted(tmp_path / "v.nrrd", example())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.6, 0.9])
def test_a_truncated_volume_is_refused(tmp_path, suffix, kept, capfd):
    path = tmp_path / f"v{suffix}"
    write_volume(path, example())
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    expected = FileError if kept else InvalidInputError
    with pytest.raises(expected, match=r"v\.") as caught:
        read_volume(path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_a_missing_volume_and_a_plane_image_are_refused(tmp_path):
    with pytest.raises(FileError, match=r"none\.nrrd"):
        read_volume(tmp_path / "none.nrrd")
    SimpleITK.WriteImage(SimpleITK.Image(4, 5, SimpleITK.sitkUInt8), str(tmp_path / "p.nrrd"))
    with pytest.raises(InvalidInputError, match="2 axes"):
        read_volume(tmp_path / "p.nrrd")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"voxels": np.zeros((2, 2), np.uint8)}, "voxels"),
        ({"voxels": np.zeros((2, 2, 2))}, "float64"),
        ({"spacing_mm": (1.0, 0.0, 1.0)}, "spacing_mm"),
    ],
)
def test_a_volume_checks_itself(change, message):
    volume = example()
    kept = {"voxels": volume.voxels, "spacing_mm": (1, 1, 1), "world_from_grid": volume.world_from_grid}
    with pytest.raises(InvalidInputError, match=message):
        Volume(**(kept | change))


@pytest.mark.realdata
def test_a_reference_volume_of_plus_is_read(realdata):
    volume = read_volume(realdata / "plus" / "vtkVolumeReconstructorTestNNMEANvolumeRef.mha")
    assert volume.shape == (147, 106, 105)
    assert volume.spacing_mm == (0.5, 0.5, 0.5)
    np.testing.assert_allclose(volume.world_from_grid.translation, [-74.5217, 165.573, 29.072])


@pytest.mark.parametrize("suffix", [".nrrd", ".mha", ".nii.gz", ".mhd", ".nhdr"])
@pytest.mark.parametrize("dtype", ["u1", "i2", "f4", "f8", "u2"])
@pytest.mark.parametrize("compress", [False, True])
def test_volumes_of_others_are_what_the_image_library_finds(tmp_path, suffix, dtype, compress):
    rng = np.random.default_rng(3)
    image = SimpleITK.GetImageFromArray(rng.integers(0, 200, (3, 4, 5)).astype(dtype))
    image.SetSpacing((0.5, 0.25, 1.1))
    image.SetOrigin((1.0, -2.0, 3.0))
    image.SetDirection(Rotation.random(rng=rng).as_matrix().ravel().tolist())
    SimpleITK.WriteImage(image, str(tmp_path / f"v{suffix}"), useCompression=compress)
    got, found = read_volume(tmp_path / f"v{suffix}"), SimpleITK.ReadImage(str(tmp_path / f"v{suffix}"))
    np.testing.assert_array_equal(got.voxels, SimpleITK.GetArrayFromImage(found).T)
    # NIfTI keeps its matrix in single precision.
    np.testing.assert_allclose(got.spacing_mm, found.GetSpacing(), rtol=1e-6)
    np.testing.assert_allclose(got.world_from_grid.translation, found.GetOrigin(), atol=1e-5)
    np.testing.assert_allclose(
        got.world_from_grid.rotation.as_matrix().ravel(), found.GetDirection(), atol=1e-6
    )
