"""Volumes and labels written in slabs and read, as SimpleITK, nibabel and Slicer's own reader find them."""

import nibabel
import numpy as np
import pytest
import SimpleITK
import slicerio
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.volume import STATE_SEGMENTS, VOXEL_TYPES, LabelMap, Segment, Volume
from speckle3d.io.voxels.volumes import SUFFIXES, read_volume, write_volume

RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
# NIfTI keeps its matrix in single precision: 6e-8 of places up to 300 mm, and of 5 voxels of a few mm.
SINGLE_MM = 1e-4
FIELDS = {
    "levels": 'log-compressed, 0 to 255 over 60 dB; <b>"quoted"</b> & Größe µm := x',
    "note": "two\nlines, a \\n that is none",
    "type": "not the format's own",
    "DimSize": "9 9 9",
}


def volume_of(seed=0, dtype="uint8", shape=(4, 5, 6)):
    rng = np.random.default_rng(seed)
    pose = RigidTransform.from_components(rng.normal(0, 100, 3), Rotation.random(rng=rng))
    voxels = rng.integers(0, 200, shape).astype(dtype)
    return Volume(voxels, tuple(rng.uniform(0.05, 3.0, 3)), pose)


def by_itk(path):
    """World (LPS) from index, and voxels, as ITK finds them."""
    image = SimpleITK.ReadImage(str(path))
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return affine, SimpleITK.GetArrayFromImage(image).T


@settings(max_examples=15)
@given(
    suffix=st.sampled_from(SUFFIXES),
    dtype=st.sampled_from(VOXEL_TYPES),
    shape=st.tuples(*[st.integers(1, 5)] * 3),
    compress=st.booleans(),
    seed=st.integers(0, 999),
)
def test_a_voxel_is_at_the_same_place_in_itk_and_here(tmp_path_factory, suffix, dtype, shape, compress, seed):
    path = tmp_path_factory.mktemp("volume") / f"v{suffix}"
    volume = volume_of(seed, dtype, shape)
    write_volume(path, volume, compress)
    back, (affine, voxels) = read_volume(path), by_itk(path)
    tolerance = SINGLE_MM if ".nii" in suffix else 1e-9
    for matrix, values in ((affine, voxels), (back.world_from_index, back.voxels)):
        np.testing.assert_allclose(matrix, volume.world_from_index, atol=tolerance)
        np.testing.assert_array_equal(values, volume.voxels)
        assert values.dtype == volume.voxels.dtype
    assert [p.name for p in path.parent.iterdir()] == [path.name]


ODD = (Segment(1, 'vein <&> "left"', (1.0, 0.0, 0.25)), Segment(7, "Nerv, größer\nzwei", (0.0, 0.5, 1.0)))


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".seg.nrrd"])
def test_labels_come_back_with_what_they_mean(tmp_path, suffix):
    path, grey = tmp_path / f"v{suffix}", volume_of(8, "uint16")
    write_volume(path, LabelMap(grey.voxels, grey.spacing_mm, grey.world_from_grid, FIELDS, ODD))
    back = read_volume(path)
    assert isinstance(back, LabelMap)
    assert (back.segments, dict(back.fields)) == (ODD, FIELDS)
    np.testing.assert_array_equal(back.voxels, grey.voxels)
    np.testing.assert_array_equal(by_itk(path)[1], grey.voxels)


def test_a_segmentation_is_slicers(tmp_path):
    voxels = np.random.default_rng(9).integers(0, 3, (6, 5, 4)).astype(np.uint8)
    labels = LabelMap(voxels, (0.5, 0.25, 1.0), RigidTransform.identity(), {}, STATE_SEGMENTS)
    write_volume(tmp_path / "state.seg.nrrd", labels)
    segmentation = slicerio.read_segmentation(str(tmp_path / "state.seg.nrrd"))
    np.testing.assert_array_equal(segmentation["voxels"], voxels)
    np.testing.assert_allclose(segmentation["ijkToLPS"], labels.world_from_index)
    assert [
        (s["labelValue"], s["name"], tuple(s["color"]), s["extent"]) for s in segmentation["segments"]
    ] == [(s.value, s.name, s.colour, [0, 5, 0, 4, 0, 3]) for s in STATE_SEGMENTS]
    slicerio.write_segmentation(str(tmp_path / "theirs.seg.nrrd"), segmentation)
    assert read_volume(tmp_path / "theirs.seg.nrrd").segments == STATE_SEGMENTS


@pytest.mark.parametrize("suffix", [".nrrd", ".mha", ".nii.gz", ".mhd", ".nhdr", ".hdr"])
@pytest.mark.parametrize(("dtype", "compress"), [("i2", False), ("f8", True)])
def test_volumes_of_others_are_what_the_image_library_finds(tmp_path, suffix, dtype, compress):
    rng = np.random.default_rng(3)
    image = SimpleITK.GetImageFromArray(rng.integers(0, 200, (3, 4, 5)).astype(dtype))
    image.SetSpacing((0.5, 0.25, 1.1))
    image.SetOrigin((1.0, -2.0, 3.0))
    image.SetDirection(Rotation.random(rng=rng).as_matrix().ravel().tolist())
    SimpleITK.WriteImage(image, str(tmp_path / f"v{suffix}"), useCompression=compress)
    volume, (affine, voxels) = read_volume(tmp_path / f"v{suffix}"), by_itk(tmp_path / f"v{suffix}")
    np.testing.assert_array_equal(volume.voxels, voxels)
    np.testing.assert_allclose(volume.world_from_index, affine, atol=1e-5)


def test_a_left_handed_file_is_turned_about_and_nothing_moves(tmp_path):
    voxels = np.random.default_rng(7).integers(0, 99, (3, 4, 5)).astype(np.int16)
    affine = np.diag([-0.5, 0.25, 2.0, 1.0])
    affine[:3, 3] = 10, 20, 30
    nibabel.save(nibabel.Nifti1Image(voxels, RAS_FROM_LPS @ affine), tmp_path / "left.nii.gz")
    volume = read_volume(tmp_path / "left.nii.gz")
    np.testing.assert_array_equal(volume.voxels, voxels[:, :, ::-1])
    np.testing.assert_allclose(volume.world_from_index @ [1, 2, 0, 1], affine @ [1, 2, 4, 1], atol=SINGLE_MM)
    np.testing.assert_allclose(volume.world_from_index @ [1, 2, 4, 1], affine @ [1, 2, 0, 1], atol=SINGLE_MM)


def test_a_volume_too_long_for_nifti_1_is_written(tmp_path):
    write_volume(tmp_path / "v.nii", volume_of(shape=(2**15, 1, 1)))
    assert read_volume(tmp_path / "v.nii").shape == (2**15, 1, 1)


@pytest.mark.parametrize(("unit", "factor"), [("meter", 1e3), (None, 1.0)])
def test_nifti_is_in_its_own_unit(tmp_path, unit, factor):
    image = nibabel.Nifti1Image(np.ones((3, 4, 5), np.uint8), np.diag([-0.2, -0.3, 0.4, 1.0]))
    if unit:
        image.header.set_xyzt_units(unit)
    nibabel.save(image, tmp_path / "v.nii")
    np.testing.assert_allclose(
        read_volume(tmp_path / "v.nii").spacing_mm, np.multiply((0.2, 0.3, 0.4), factor), rtol=1e-6
    )


def test_nrrd_is_in_its_own_unit_and_space(tmp_path):
    (tmp_path / "v.nrrd").write_bytes(
        b"NRRD0005\ntype: uint8\ndimension: 3\nsizes: 2 3 4\nspace: right-anterior-superior\n"
        b"space directions: (0.02,0,0) (0,0.03,0) (0,0,0.04)\nspace origin: (1,2,3)\n"
        b'space units: "cm" "cm" "cm"\nencoding: raw\n\n' + bytes(24)
    )
    expected = np.diag([-0.2, -0.3, 0.4, 1.0])
    expected[:3, 3] = -10, -20, 30
    np.testing.assert_allclose(read_volume(tmp_path / "v.nrrd").world_from_index, expected)


def test_an_origin_with_too_few_numbers_is_an_error(tmp_path):
    (tmp_path / "v.nrrd").write_bytes(
        b"NRRD0005\ntype: uint8\ndimension: 3\nsizes: 2 3 4\nspace: left-posterior-superior\n"
        b"kinds: domain domain domain\nspace directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (1,2)\n"
        b"encoding: raw\n\n" + bytes(24)
    )
    with pytest.raises(InvalidInputError, match="origin of 2"):
        read_volume(tmp_path / "v.nrrd")
