"""Volumes written in slabs, as SimpleITK, nibabel, pynrrd and Slicer's own readers find them."""

import gzip
import itertools

import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK
import slicerio
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import FileError, InvalidInputError, MismatchError
from speckle3d.core.labels import STATE_SEGMENTS, LabelMap, Segment
from speckle3d.core.volume import VOXEL_TYPES, Volume
from speckle3d.io.describe import describe
from speckle3d.io.voxels import volume_writer
from speckle3d.io.voxels.volume_writer import SUFFIXES, VolumeWriter
from speckle3d.io.voxels.volumes import read_volume, write_volume

RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
# NIfTI keeps its matrix in single precision: 6e-8 of places up to 300 mm, and of 5 voxels of a few mm.
SINGLE_MM = 1e-4


def volume_of(seed, dtype="uint8", shape=(4, 5, 6), rotation=None, fields=None):
    rng = np.random.default_rng(seed)
    turned = Rotation.random(rng=rng) if rotation is None else rotation
    spacing = tuple(rng.uniform(0.05, 3.0, 3))
    pose = RigidTransform.from_components(rng.normal(0, 100, 3), turned)
    return Volume(rng.integers(0, 200, shape).astype(dtype), spacing, pose, fields or {})


def affine_of(path):
    """LPS from index as somebody else's reader finds it, and the voxels [i, j, k] it finds."""
    if path.name.endswith(".nrrd"):
        voxels, header = nrrd.read(str(path))
        assert header["space"] == "left-posterior-superior"
        assert header["space units"] == ["mm"] * 3
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = header["space directions"].T, header["space origin"]
        return found, voxels
    if path.name.endswith(".mha"):
        return itk_affine(path)
    image = nibabel.load(path)
    assert image.header.get_xyzt_units()[0] == "mm"
    assert image.header["sform_code"] == image.header["qform_code"] == 1
    return RAS_FROM_LPS @ image.affine, np.asanyarray(image.dataobj)


def itk_affine(path):
    image = SimpleITK.ReadImage(str(path))
    found = np.eye(4)
    found[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    found[:3, 3] = image.GetOrigin()
    return found, SimpleITK.GetArrayFromImage(image).T


@settings(deadline=None, max_examples=25)
@given(
    suffix=st.sampled_from(SUFFIXES),
    dtype=st.sampled_from(VOXEL_TYPES),
    shape=st.tuples(*[st.integers(1, 5)] * 3),
    compress=st.booleans(),
    seed=st.integers(0, 999),
)
@example(suffix=".nii.gz", dtype="float32", shape=(1, 1, 1), compress=True, seed=0)
@example(suffix=".mha", dtype="uint16", shape=(1, 1, 1), compress=True, seed=0)
@example(suffix=".nrrd", dtype="int16", shape=(1, 5, 1), compress=False, seed=0)
def test_a_voxel_is_at_the_same_place_in_everybodys_reader(
    tmp_path_factory, suffix, dtype, shape, compress, seed
):
    path = tmp_path_factory.mktemp("volume") / f"v{suffix}"
    volume = volume_of(seed, dtype, shape)
    write_volume(path, volume, compress)
    corners = np.array([*itertools.product(*[(0, n - 1) for n in shape])])
    indices = np.column_stack((corners, np.ones(8)))
    places = indices @ volume.world_from_index.T
    for affine, voxels in (affine_of(path), itk_affine(path)):
        np.testing.assert_allclose(
            indices @ affine.T, places, atol=SINGLE_MM if ".nii" in suffix else 1e-9, rtol=0
        )
        np.testing.assert_array_equal(voxels, volume.voxels)
        assert voxels.dtype == volume.voxels.dtype
    back = read_volume(path)
    assert back.voxels.dtype == volume.voxels.dtype
    np.testing.assert_array_equal(back.voxels, volume.voxels)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", VOXEL_TYPES)
@pytest.mark.parametrize(
    ("suffix", "reader"),
    [(".nrrd", "Nrrd"), (".mha", "MetaImage"), (".nii.gz", "NIFTIImage"), (".nii", "NIFTIImage")],
)
def test_vtk_finds_the_same_voxels(tmp_path, suffix, reader, dtype):
    readers = pytest.importorskip("vtkmodules.vtkIOImage")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    volume = volume_of(10, dtype, (7, 6, 5), fields=FIELDS)
    write_volume(tmp_path / f"v{suffix}", volume)
    found = getattr(readers, f"vtk{reader}Reader")()
    found.SetFileName(str(tmp_path / f"v{suffix}"))
    found.Update()
    voxels = vtk_to_numpy(found.GetOutput().GetPointData().GetScalars())
    np.testing.assert_array_equal(voxels.reshape(5, 6, 7).T, volume.voxels)
    assert voxels.dtype == dtype
    if reader != "Nrrd":  # which loses the first of oblique directions, in files of ITK's too
        np.testing.assert_allclose(found.GetOutput().GetSpacing(), volume.spacing_mm, rtol=1e-6)


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 180.0, 179.99, 179.0])
@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0), (1, 2, 3)])
def test_near_a_half_turn_nifti_is_as_exact(tmp_path, turn_deg, axis):
    """There the quaternion's first number, which is not stored, comes back to 3e-4 only."""
    turned = Rotation.from_rotvec(np.deg2rad(turn_deg) * np.array(axis) / np.linalg.norm(axis))
    volume = volume_of(1, "uint8", (50, 40, 30), turned)
    write_volume(tmp_path / "v.nii", volume)
    for affine, _ in (affine_of(tmp_path / "v.nii"), itk_affine(tmp_path / "v.nii")):
        np.testing.assert_allclose(affine, volume.world_from_index, atol=SINGLE_MM, rtol=0)
    by_quaternion = RAS_FROM_LPS @ nibabel.load(tmp_path / "v.nii").get_qform()
    np.testing.assert_allclose(by_quaternion[:3, :3], volume.world_from_index[:3, :3], atol=2e-3)


@pytest.mark.parametrize(
    ("rotation", "letters"),
    [
        (np.eye(3), "RAI"),
        (np.diag([-1, -1, 1]), "LPI"),
        (np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), "AIR"),
        (np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), "PSR"),
    ],
)
def test_the_anatomical_orientation_of_a_metaimage_is_itks(tmp_path, rotation, letters):
    volume = volume_of(2, rotation=Rotation.from_matrix(rotation) * Rotation.from_rotvec([0.1, -0.2, 0.15]))
    write_volume(tmp_path / "v.mha", volume, compress=False)
    SimpleITK.WriteImage(SimpleITK.ReadImage(str(tmp_path / "v.mha")), str(tmp_path / "itk.mha"))
    for name in ("v.mha", "itk.mha"):
        header = (tmp_path / name).read_bytes().split(b"ElementDataFile")[0].decode()
        assert f"AnatomicalOrientation = {letters}\n" in header


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_slabs_and_threads_do_not_show_in_the_file(tmp_path, suffix, monkeypatch):
    volume = volume_of(3, "int16", (40, 30, 20))
    write_volume(tmp_path / f"whole{suffix}", volume)
    whole = (tmp_path / f"whole{suffix}").read_bytes()
    for cores, cuts in ((1, (0, 1, 2, 20)), (3, (0, 7, 20))):
        monkeypatch.setenv("NUMBA_NUM_THREADS", str(cores))
        path = tmp_path / f"slabs{suffix}"
        place = volume.shape, volume.spacing_mm, volume.world_from_grid
        with VolumeWriter(path, *place, "int16") as writer:
            for first, stop in itertools.pairwise(cuts):
                planes = np.asfortranarray(volume.voxels.T[first:stop])
                writer.append(planes)
                planes[:] = -1  # the writer holds no view of it
        assert path.read_bytes() == whole


def test_numbers_in_the_other_byte_order_are_the_same(tmp_path):
    volume = volume_of(3, "int16")
    turned = Volume(volume.voxels.astype(">i2"), volume.spacing_mm, volume.world_from_grid)
    for suffix in SUFFIXES:
        for name, each in (("little", volume), ("big", turned)):
            write_volume(tmp_path / f"{name}{suffix}", each)
        assert (tmp_path / f"big{suffix}").read_bytes() == (tmp_path / f"little{suffix}").read_bytes()


def test_larger_than_its_batches_and_what_does_not_pack(tmp_path, monkeypatch):
    monkeypatch.setattr(volume_writer, "_BATCH_BYTES", 2**14)
    noise = np.random.default_rng(4).integers(0, 256, (64, 50, 30)).astype(np.uint8)
    noise[:, :, 12:] = 7
    volume = Volume(np.asfortranarray(noise), (1, 1, 1), RigidTransform.identity())
    for suffix in (".nrrd", ".mha", ".nii.gz"):
        write_volume(tmp_path / f"v{suffix}", volume)
        np.testing.assert_array_equal(itk_affine(tmp_path / f"v{suffix}")[1], noise)
    assert gzip.decompress((tmp_path / "v.nii.gz").read_bytes())[352:] == noise.tobytes(order="F")


def test_members_of_gzip_that_follow_one_another_are_one_volume(tmp_path):
    """As bgzip and pigz write them."""
    volume = volume_of(4, "int16")
    write_volume(tmp_path / "v.nii", volume)
    whole = (tmp_path / "v.nii").read_bytes()
    parts = [gzip.compress(whole[i : i + 100]) for i in range(0, len(whole), 100)]
    (tmp_path / "v.nii.gz").write_bytes(b"".join(parts))
    np.testing.assert_array_equal(read_volume(tmp_path / "v.nii.gz").voxels, volume.voxels)
    (tmp_path / "v.nii.gz").write_bytes(b"".join(parts[:-1]))
    with pytest.raises(FileError, match=r"v\.nii\.gz: cannot be read as NIfTI"):
        read_volume(tmp_path / "v.nii.gz")


FIELDS = {
    "levels": 'log-compressed, 0 to 255 over 60 dB; <b>"quoted"</b> & Größe µm := x',
    "note": "two\nlines, a \\n that is none, and a tab's \\t",
    "made_by": "speckle3d",
    "type": "not the format's own",
    "sizes": "1 1 1",
    "DimSize": "9 9 9",
}


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_fields_come_back_and_take_nobodys_place(tmp_path, suffix):
    path = tmp_path / f"v{suffix}"
    volume = volume_of(5, fields=FIELDS)
    write_volume(path, volume)
    assert dict(read_volume(path).fields) == FIELDS
    np.testing.assert_array_equal(itk_affine(path)[1], volume.voxels)
    np.testing.assert_array_equal(affine_of(path)[1], volume.voxels)


@settings(deadline=None, max_examples=30)
@given(
    suffix=st.sampled_from(SUFFIXES),
    text=st.text(
        st.characters(exclude_categories=["Cs", "Cc", "Cf", "Co", "Cn", "Zl", "Zp"]) | st.just("\n")
    ),
)
def test_any_text_that_can_be_shown_comes_back(tmp_path_factory, suffix, text):
    path = tmp_path_factory.mktemp("volume") / f"v{suffix}"
    write_volume(path, volume_of(0, fields={"a": text}))
    assert read_volume(path).fields["a"] == (text if ".nii" in suffix else text.strip())


def test_other_readers_find_the_fields_too(tmp_path):
    for suffix in (".nrrd", ".mha", ".nii"):
        write_volume(tmp_path / f"v{suffix}", volume_of(6, fields=FIELDS))
    image = SimpleITK.ReadImage(str(tmp_path / "v.nrrd"))
    assert image.GetMetaData("Speckle3D_note") == FIELDS["note"]
    assert SimpleITK.ReadImage(str(tmp_path / "v.mha")).GetMetaData("Speckle3D_made_by") == "speckle3d"
    held = nibabel.load(tmp_path / "v.nii").header
    assert bytes(held["descrip"]).startswith(b"speckle3d; levels: log-compressed, 0 to 255 over 60 dB")
    assert b"two\\nlines" in held.extensions[0].get_content()


def test_control_characters_cannot_forge_a_field(tmp_path):
    for suffix in (".nrrd", ".mha"):
        write_volume(tmp_path / f"v{suffix}", volume_of(0, fields={"a": "x\r\nSpeckle3D_b = y\x1b\0\x85z"}))
        fields = read_volume(tmp_path / f"v{suffix}").fields
        assert list(fields) == ["a"]
        assert fields["a"] == "x\nSpeckle3D_b = y\\x1b\\x00\\x85z"


@pytest.mark.parametrize("name", ["", "a b", "a:=b", "a\nb", "ä", "1a", "a=b"])
def test_a_name_that_a_header_cannot_hold_is_refused(tmp_path, name):
    with pytest.raises(InvalidInputError, match=r"v\.nrrd: fields"):
        write_volume(tmp_path / "v.nrrd", volume_of(0, fields={name: "x"}))
    assert list(tmp_path.iterdir()) == []


def writer_of(path, **others):
    place = {
        "shape": (4, 3, 2),
        "spacing_mm": (1.0, 1.0, 1.0),
        "world_from_grid": RigidTransform.identity(),
        "dtype": "uint8",
    }
    return VolumeWriter(path, **(place | others))


@pytest.mark.parametrize(
    ("others", "words"),
    [
        ({"dtype": "float64"}, "float64"),
        ({"dtype": ">i2"}, None),
        ({"shape": (4, 0, 2)}, "shape"),
        ({"spacing_mm": (1.0, np.nan, 1.0)}, "spacing_mm"),
        ({"world_from_grid": RigidTransform.identity(2)}, "world_from_grid"),
        ({"dtype": "int16", "segments": ()}, "labels"),
    ],
)
def test_what_is_no_volume_is_refused_before_a_file_is_there(tmp_path, others, words):
    if words is None:
        writer_of(tmp_path / "v.nrrd", **others)
    else:
        with pytest.raises(InvalidInputError, match=rf"v\.nrrd: .*{words}"):
            writer_of(tmp_path / "v.nrrd", **others)
    assert list(tmp_path.iterdir()) == []


def appended(path, pieces):
    with writer_of(path) as writer:
        for piece in pieces:
            writer.append(piece)


@pytest.mark.parametrize(
    ("pieces", "words"),
    [
        ([], "2 planes, got 0"),
        ([np.zeros((1, 3, 4), np.uint8)], "2 planes, got 1"),
        ([np.zeros((3, 3, 4), np.uint8)], "at most 2 planes"),
        ([np.zeros((2, 4, 3), np.uint8)], r"3 x 4 voxels \(j x i\)"),
        ([np.zeros((2, 3, 4), np.int16)], "uint8, got int16"),
    ],
)
def test_planes_that_are_not_the_volumes_leave_no_file(tmp_path, pieces, words):
    with pytest.raises(MismatchError, match=words):
        appended(tmp_path / "v.nii.gz", pieces)
    assert list(tmp_path.iterdir()) == []


def test_an_axis_that_nifti_cannot_count_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="32767"):
        writer_of(tmp_path / "v.nii", shape=(40_000, 1, 1))
    writer_of(tmp_path / "v.nrrd", shape=(40_000, 1, 1))


def test_a_left_handed_file_is_turned_about_and_nothing_moves(tmp_path):
    voxels = np.random.default_rng(7).integers(0, 99, (3, 4, 5)).astype(np.int16)
    affine = np.diag([-0.5, 0.25, 2.0, 1.0]) @ np.eye(4)
    affine[:3, 3] = 10, 20, 30
    nibabel.save(nibabel.Nifti1Image(voxels, RAS_FROM_LPS @ affine), tmp_path / "left.nii.gz")
    found = read_volume(tmp_path / "left.nii.gz")
    assert found.voxels.dtype == np.int16
    for index in itertools.product(range(3), range(4), range(5)):
        place = np.array([*index, 1]) @ affine.T
        at = np.rint(np.linalg.solve(found.world_from_index, place)[:3]).astype(int)
        np.testing.assert_allclose(np.array([*at, 1]) @ found.world_from_index.T, place, atol=SINGLE_MM)
        assert found.voxels[tuple(at)] == voxels[index]


ODD = (Segment(1, 'vein <&> "left"', (1.0, 0.0, 0.25)), Segment(7, "Nerv, größer\nzwei", (0.0, 0.5, 1.0)))


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".seg.nrrd"])
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_labels_come_back_with_what_they_mean(tmp_path, suffix, dtype):
    path = tmp_path / f"v{suffix}"
    grey = volume_of(8, dtype)
    write_volume(path, LabelMap(grey.voxels, grey.spacing_mm, grey.world_from_grid, {"a": "b"}, ODD))
    back = read_volume(path)
    assert isinstance(back, LabelMap)
    assert back.segments == ODD
    assert dict(back.fields) == {"a": "b"}
    np.testing.assert_array_equal(back.voxels, grey.voxels)
    np.testing.assert_array_equal(itk_affine(path)[1], grey.voxels)
    assert back.voxels.dtype == dtype
    if ".nii" in suffix:
        assert nibabel.load(path).header.get_intent()[0] == "label"


def test_a_segmentation_is_slicers(tmp_path):
    voxels = np.random.default_rng(9).integers(0, 3, (6, 5, 4)).astype(np.uint8)
    labels = LabelMap(voxels, (0.5, 0.25, 1.0), RigidTransform.identity(), {}, STATE_SEGMENTS)
    write_volume(tmp_path / "state.seg.nrrd", labels)
    found = slicerio.read_segmentation(str(tmp_path / "state.seg.nrrd"))
    np.testing.assert_array_equal(found["voxels"], voxels)
    np.testing.assert_allclose(found["ijkToLPS"], labels.world_from_index)
    assert found["containedRepresentationNames"] == ["Binary labelmap"]
    assert found["masterRepresentation"] == "Binary labelmap"
    told = [(s["labelValue"], s["name"], tuple(s["color"]), s["extent"]) for s in found["segments"]]
    assert told == [(s.value, s.name, s.colour, [0, 5, 0, 4, 0, 3]) for s in STATE_SEGMENTS]
    # One that Slicer's library writes is read as well.
    slicerio.write_segmentation(str(tmp_path / "theirs.seg.nrrd"), found)
    assert read_volume(tmp_path / "theirs.seg.nrrd").segments == STATE_SEGMENTS


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("Segment0_LabelValue:=half", "Segment0_LabelValue"),
        ("Segment0_LabelValue:=0", "from 1"),
        ("Segment0_Color:=1 1", "Segment0_Color"),
        ("Segment0_Color:=1 1 2", "colour"),
        ("Segment0_Layer:=1", "Segment0_Layer"),
        ("Segment0_LabelValue:=300", "up to 255"),
        ("Segment1_LabelValue:=1", "one for each label"),
    ],
)
def test_segments_that_make_no_sense_are_named(tmp_path, field, message):
    path = tmp_path / "s.seg.nrrd"
    labels = LabelMap(np.zeros((2, 2, 2), np.uint8), (1, 1, 1), RigidTransform.identity(), {}, STATE_SEGMENTS)
    write_volume(path, labels)
    lines = path.read_bytes().split(b"\n\n", 1)
    name = field.split(":=")[0].encode()
    kept = [field.encode() if each.startswith(name + b":=") else each for each in lines[0].split(b"\n")]
    path.write_bytes(b"\n".join(kept) + b"\n\n" + lines[1])
    with pytest.raises(InvalidInputError, match=message) as caught:
        read_volume(path)
    assert str(path) in str(caught.value)


def test_a_segmentation_of_no_labels_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match=r"seg\.nrrd is of labels"):
        write_volume(tmp_path / "v.seg.nrrd", volume_of(0))


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".seg.nrrd"])
def test_info_tells_what_a_volume_holds(tmp_path, suffix):
    path = tmp_path / f"v{suffix}"
    volume = Volume(
        np.full((4, 3, 2), 2, np.uint8), (0.5, 0.25, 1.0), RigidTransform.identity(), {"levels": "linear"}
    )
    if suffix == ".seg.nrrd":
        volume = LabelMap(
            volume.voxels, volume.spacing_mm, volume.world_from_grid, volume.fields, STATE_SEGMENTS
        )
    write_volume(path, volume)
    told = {what: (value, unit) for what, value, unit in describe(path)}
    assert told["voxels"] == ("4 x 3 x 2", "")
    assert told["spacing"] == ("0.5 x 0.25 x 1", "mm")
    assert told["voxel type"] == ("uint8", "")
    assert told["levels"] == ("linear", "")
    if suffix == ".seg.nrrd":
        assert told["label 2"] == ("filled: 24", "voxels")
    else:
        assert told["levels found"] == ("2 to 2", "")
