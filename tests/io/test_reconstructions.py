import json
from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
import sweep_examples
from image_examples import grey, write_mha

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.reconstruction import FramePairs, ModeErrors, Provenance, SharedErrors, SourceFile, Trust
from speckle3d.core.sweep import ImageGrid
from speckle3d.io.describe import describe
from speckle3d.io.load import import_record
from speckle3d.io.reconstructions import ReconstructionWriter, read_reconstruction
from speckle3d.io.sweep_writer import write_sweep

N, PATCHES = 8, 6
GRID = ImageGrid(128, 2000, 0.3, 0.01925, 1.5)
PROVENANCE = Provenance("sweep.h5", "ab" * 32, "0.1.0")
TIMES = 0.04 * np.arange(N)
CONFIG = "# kept\n[motion]\npatch_mm = 5.0\n"


def pairs(first, seed=0):
    rng = np.random.default_rng(seed)
    e = len(first)
    distance = rng.random((e, PATCHES)).astype(np.float32)
    distance[0, 0] = np.nan
    return FramePairs(
        first=np.asarray(first),
        second=np.asarray(first) + 1,
        first_from_second=sweep_examples.poses(e, seed).as_matrix(),
        covariance=np.tile(np.eye(6), (e, 1, 1)),
        distance_mm=distance,
        sigma_mm=rng.random((e, PATCHES)).astype(np.float32),
        used=rng.random((e, PATCHES)) > 0.5,
        patch_centre_mm=np.arange(2.0 * PATCHES).reshape(PATCHES, 2),
    )


POSES = {"image": sweep_examples.poses(N), "pose": sweep_examples.poses(N, 1)}


TRUST = Trust(
    np.tile(np.diag([1.0, 2, 3, 4, 5, 6]), (N, 1, 1)),
    np.array([0, 0, 1, 0, 16, 0, 0, 8]),
    SharedErrors(0.02, 0.07, np.array([1e-3, 2e-3])),
    {"fused": ModeErrors(np.tile(np.eye(6), (N, 1, 1)), 0.004)},
)


def write(path, chunks=(), poses=POSES, finish=True, trust=TRUST):
    with ReconstructionWriter(path, TIMES, GRID) as writer:
        for chunk in chunks:
            writer.append_pairs(chunk)
        if finish:
            writer.finish(poses, PROVENANCE, CONFIG, trust)


@pytest.fixture
def path(tmp_path):
    write(tmp_path / "r.h5", [pairs([0, 1, 2]), pairs([3, 4], 1)])
    return tmp_path / "r.h5"


def test_everything_a_reconstruction_holds_comes_back(path):
    got = read_reconstruction(path)
    assert (got.grid, got.provenance, got.config_toml) == (GRID, PROVENANCE, CONFIG)
    np.testing.assert_array_equal(got.frame_time_s, TIMES)
    assert set(got.poses) == {"image", "pose"}
    for mode, expected in POSES.items():
        np.testing.assert_allclose(got.poses[mode].as_matrix(), expected.as_matrix(), atol=1e-12)
    assert len(got.pairs) == 5
    for field in fields(FramePairs):
        parts = [getattr(pairs([0, 1, 2]), field.name), getattr(pairs([3, 4], 1), field.name)]
        expected = parts[0] if field.name == "patch_centre_mm" else np.concatenate(parts)
        np.testing.assert_array_equal(getattr(got.pairs, field.name), expected)
        assert getattr(got.pairs, field.name).dtype == expected.dtype


def test_how_far_poses_may_be_trusted_comes_back(path, tmp_path):
    got = read_reconstruction(path).trust
    np.testing.assert_array_equal(got.covariance, TRUST.covariance)
    np.testing.assert_array_equal(got.flags, TRUST.flags)
    assert (got.shared.scale_sigma, got.shared.curves_sigma) == (0.02, 0.07)
    np.testing.assert_array_equal(got.shared.turn_sigma_per_mm, [1e-3, 2e-3])
    assert list(got.modes) == ["fused"]
    assert got.modes["fused"].length_sigma == 0.004
    np.testing.assert_array_equal(got.modes["fused"].covariance, TRUST.modes["fused"].covariance)
    write(tmp_path / "old.h5", trust=Trust(TRUST.covariance, TRUST.flags))
    old = read_reconstruction(tmp_path / "old.h5").trust
    assert old.shared is None
    assert old.modes == {}
    write(tmp_path / "older.h5", trust=None)
    assert read_reconstruction(tmp_path / "older.h5").trust is None


@pytest.mark.parametrize(
    ("trust", "message"),
    [
        (Trust(TRUST.covariance[1:], TRUST.flags), r"covariance.*\(8, 6, 6\).*\(7, 6, 6\)"),
        (Trust(TRUST.covariance[..., 0], TRUST.flags), r"covariance.*\(8, 6, 6\).*\(8, 6\)"),
        (Trust(TRUST.covariance, TRUST.flags[:3]), r"flags.*\(8,\).*\(3,\)"),
    ],
)
def test_trust_of_other_frames_is_refused(tmp_path, trust, message):
    with pytest.raises(InvalidInputError, match=message):
        write(tmp_path / "r.h5", trust=trust)
    assert list(tmp_path.iterdir()) == []


def test_pairs_may_be_left_out(path, tmp_path):
    assert read_reconstruction(path, with_pairs=False).pairs is None
    write(tmp_path / "none.h5")
    assert read_reconstruction(tmp_path / "none.h5").pairs is None


def test_the_place_is_tried_before_the_work(tmp_path):
    with (
        pytest.raises(FileError, match="expected an existing folder"),
        ReconstructionWriter(tmp_path / "none" / "r.h5", TIMES, GRID),
    ):
        raise AssertionError("the work began")


def test_an_interrupted_reconstruction_leaves_nothing(tmp_path):
    def chunks():
        yield pairs([0, 1])
        assert len(list(tmp_path.iterdir())) == 1
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "r.h5", chunks())
    assert list(tmp_path.iterdir()) == []


def test_an_unfinished_reconstruction_is_an_error(tmp_path):
    with pytest.raises(InvalidInputError, match="finish"):
        write(tmp_path / "r.h5", [pairs([0])], finish=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("chunk", "message"),
    [
        (replace(pairs([0]), second=np.array([N])), rf"/pairs\[0\].*{N}"),
        (replace(pairs([0]), used=np.ones((1, 2), bool)), r"/pairs/used.*\(1, 6\).*\(1, 2\)"),
        (replace(pairs([0]), covariance=np.eye(6)), r"/pairs/covariance.*\(1, 6, 6\)"),
        (replace(pairs([0]), patch_centre_mm=np.zeros((6, 2))), r"/pairs/patch_centre_mm"),
    ],
)
def test_pairs_that_do_not_fit_are_refused(tmp_path, chunk, message):
    with pytest.raises(InvalidInputError, match=message):
        write(tmp_path / "r.h5", [pairs([0, 1]), chunk])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ({"pose": POSES["pose"]}, "'image'"),
        ({"image": sweep_examples.poses(3)}, f"mode image.*{N}.*3"),
        (POSES | {"other": POSES["pose"]}, "other"),
    ],
)
def test_poses_that_do_not_fit_are_refused(tmp_path, poses, message):
    with pytest.raises(InvalidInputError, match=message):
        write(tmp_path / "r.h5", poses=poses)
    assert list(tmp_path.iterdir()) == []


def edit_entry(node, index, value):
    return lambda file: file[node].__setitem__(index, value)


def replace_entry(node, values):
    def edit(file):
        del file[node]
        file[node] = values

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (edit_entry("poses/image", (4, 1, 1), 7.0), r"/poses/image\[4\]"),
        (edit_entry("pairs/first_from_second", (2, 0, 0), np.nan), r"first_from_second\[\(2, 0, 0\)\]"),
        (edit_entry("pairs/second", 1, 0), r"/pairs\[1\]"),
        (lambda file: file["pairs"].__delitem__("used"), r"/pairs/used"),
        (lambda file: file.__delitem__("poses"), r"/poses"),
        (lambda file: file["poses"].__delitem__("image"), r"r\.h5.*'image'"),
        (lambda file: file.attrs.__delitem__("input_sha256"), r"input_sha256"),
        (lambda file: file.attrs.__setitem__("vector_pitch_mm", 0), r"r\.h5: vector_pitch_mm"),
        (replace_entry("frame_flags", np.zeros(3, int)), r"/frame_flags.*\(8,\).*\(3,\)"),
        (replace_entry("pose_covariance/image", np.eye(6)), r"/pose_covariance/image.*\(8, 6, 6\)"),
        (edit_entry("pose_covariance/image", (3, 2, 2), np.nan), r"/pose_covariance/image\[.*3, 2, 2"),
        (lambda file: file.attrs.__setitem__("version", 9), r"speckle3d.reconstruction version 1, got 9"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(path, edit, message):
    with h5py.File(path, "r+") as file:
        edit(file)
    with pytest.raises(InvalidInputError, match=message) as caught:
        read_reconstruction(path)
    assert str(caught.value).count(str(path)) == 1
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kept", [0.0, 0.2, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_a_file_error(path, kept):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(FileError, match=r"r\.h5: "):
        read_reconstruction(path)


def test_the_crossing_sweep_is_on_record(tmp_path):
    crossed = replace(PROVENANCE, crossing=SourceFile("crossing.h5", "cd" * 32))
    with ReconstructionWriter(tmp_path / "r.h5", TIMES, GRID) as writer:
        writer.finish(POSES, crossed, CONFIG, TRUST)
    assert read_reconstruction(tmp_path / "r.h5").provenance == crossed


def test_settings_that_were_in_force_are_on_record(tmp_path):
    recording = write_mha(tmp_path / "a.mha", grey())
    assert import_record(recording) is None
    toml = "dynamic_range_db = 50\nbandwidth_hz = [3e6, 7e6]\narrays = {rf = 'A'}"
    (tmp_path / "import.toml").write_text(toml)
    record = import_record(recording)
    assert record.name == "import.toml"
    expected = {"dynamic_range_db": 50, "bandwidth_hz": [3e6, 7e6], "arrays": {"rf": "A"}}
    assert json.loads(record.settings_json) == expected
    with ReconstructionWriter(tmp_path / "r.h5", TIMES, GRID) as writer:
        writer.finish(POSES, replace(PROVENANCE, imported=record), CONFIG, TRUST)
    assert read_reconstruction(tmp_path / "r.h5").provenance.imported == record
    rows = describe(tmp_path / "r.h5")
    assert ("import settings of", "import.toml", "") in rows
    assert ("import settings", record.settings_json, "") in rows
    # A sweep file says all itself.
    write_sweep(tmp_path / "s.h5", sweep_examples.bmode_sweep())
    assert import_record(tmp_path / "s.h5") is None
