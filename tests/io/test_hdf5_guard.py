"""HDF5 files that point out of themselves, or claim data that they do not hold, are refused in one line."""

import os
import sys
import zlib

import h5py
import numpy as np
import oracles
import pytest
import sweep_examples
from calibration_files import made

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.io.calibrations import read_calibration, write_calibration
from speckle3d.io.challenge import is_challenge_scan
from speckle3d.io.hdf5 import read_attribute, read_text
from speckle3d.io.hdf5_guard import follow, require_texts
from speckle3d.io.inflate import inflate
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.io.sweeps import read_sweep

SHAPE = (6, 5, 40)


@pytest.fixture
def path(tmp_path):
    write_sweep(tmp_path / "s.h5", sweep_examples.rf_sweep())
    return tmp_path / "s.h5"


def in_place_of(path, name, make):
    """Put what `make(file, name)` makes in place of a member, and keep its attributes."""
    with h5py.File(path, "r+") as file:
        kept = dict(file[name].attrs)
        del file[name]
        make(file, name)
        if isinstance(file.get(name, getlink=True), h5py.HardLink):
            file[name].attrs.update(kept)


def linked(link):
    return lambda file, name: file.__setitem__(name, link)


def all_frames(path):
    sweep = read_sweep(path)
    try:
        return np.stack([sweep.frames[i] for i in range(len(sweep))])
    finally:
        sweep.frames.close()


@pytest.mark.parametrize(
    "name", ["tracker", "orientation", "truth", "tracker/valid", "orientation/gyroscope_rad_s", "rf"]
)
@pytest.mark.parametrize(
    ("link", "got"),
    [
        (h5py.SoftLink("/none"), "nothing"),
        (h5py.ExternalLink("none.h5", "/tracker"), "another file"),
        (h5py.ExternalLink("/dev/zero", "/tracker"), "another file"),
    ],
)
def test_a_broken_link_is_an_error_and_not_the_absence_of_a_sensor(path, name, link, got):
    in_place_of(path, name, linked(link))
    with pytest.raises(InvalidInputError, match=rf"s\.h5: /{name}: .*{got}") as caught:
        read_sweep(path)
    assert "\n" not in str(caught.value)


def test_links_are_followed_within_the_file_and_no_farther(path, tmp_path):
    before = read_sweep(path)
    with h5py.File(path, "r+") as file:
        file.move("tracker", "kept/elsewhere")
        file["tracker"] = h5py.SoftLink("/kept/./elsewhere")
        file["a"], file["b"] = h5py.SoftLink("/b"), h5py.SoftLink("a")
        file["out"] = h5py.ExternalLink("other.h5", "/")
        file["through"] = h5py.SoftLink("/out/tracker")
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["tracker"] = 1.0
    np.testing.assert_array_equal(read_sweep(path).tracker.readings.time_s, before.tracker.readings.time_s)
    with h5py.File(path) as file:
        with pytest.raises(InvalidInputError, match="circle"):
            follow(file, "a")
        with pytest.raises(InvalidInputError, match="another file"):
            follow(file, "through")
        assert follow(file, "none/at/all") is None
        assert follow(file, "frame_time_s/below") is None


def external(target):
    return lambda file, name: file.create_dataset(name, SHAPE, np.int16, external=[(target, 0, 2400)])


def virtual(file, name):
    layout = h5py.VirtualLayout(SHAPE, np.int16)
    layout[...] = h5py.VirtualSource("other.h5", "rf", SHAPE)
    file.create_virtual_dataset(name, layout)


def unwritten(shape, **how):
    return lambda file, name: file.create_dataset(name, shape, np.int16, **how)


CHUNK = {"chunks": (1, 5, 40), "compression": "gzip"}


def half_written(file, name):
    file.create_dataset(name, SHAPE, np.int16, **CHUNK)[:3] = 7


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (external("/etc/passwd"), "/etc/passwd"),
        (external("/dev/zero"), "/dev/zero"),
        (virtual, "virtual"),
        (unwritten(SHAPE), "2400 bytes.*got 0"),
        (unwritten(SHAPE, **CHUNK), "6 chunks.*got 0"),
        (half_written, "6 chunks.*got 3"),
        (unwritten((10**12, 5, 40), **CHUNK), "1000000000000 chunks.*got 0"),
        (unwritten((10**12, 5, 40)), "400000000000000 bytes.*got 0"),
        (unwritten((6, 50_000, 40_000), chunks=(1, 50_000, 40_000)), "at most.*4000000000"),
    ],
)
def test_data_that_lie_elsewhere_or_nowhere_are_refused(path, make, message):
    in_place_of(path, "rf", make)
    with pytest.raises(InvalidInputError, match=rf"s\.h5: /rf: .*{message}"):
        read_sweep(path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (external("/etc/passwd"), "/etc/passwd"),
        (virtual, "virtual"),
        (unwritten((*SHAPE, 2), chunks=(1, 5, 40, 2)), "6 chunks.*got 0"),
        (unwritten((10**12, 5, 40, 2)), "800000000000000 bytes.*got 0"),
        (unwritten((6, 50_000, 40_000, 2), chunks=(1, 50_000, 40_000, 2)), "at most.*8000000000"),
    ],
)
def test_the_same_of_i_and_q(path, make, message):
    write_sweep(path, sweep_examples.iq_sweep())
    in_place_of(path, "iq", make)
    with pytest.raises(InvalidInputError, match=rf"s\.h5: /iq: .*{message}"):
        read_sweep(path)


def test_the_same_of_what_is_read_whole(path):
    in_place_of(
        path, "frame_time_s", lambda file, name: file.create_dataset(name, (10**12,), "f8", chunks=(6,))
    )
    with pytest.raises(InvalidInputError, match=r"/frame_time_s: .*chunks"):
        read_sweep(path)


def rechunked(chunks, raw, mask=0, **how):
    """A first chunk of these bytes in a data set of zeros."""

    def make(file, name):
        node = file.create_dataset(name, data=np.zeros(SHAPE, np.int16), chunks=chunks, **how)
        node.id.write_direct_chunk((0, 0, 0), raw, mask)

    return make


ONE, TWO = (1, 5, 40), (2, 5, 20)
LZF = {"compression": "lzf"}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (rechunked(ONE, zlib.compress(b"\7" * 399), compression="gzip"), "400 bytes, got 399"),
        (rechunked(ONE, zlib.compress(b"\7" * 401), compression="gzip"), "400 bytes, got more"),
        (rechunked(ONE, zlib.compress(bytes(10**8)), compression="gzip"), "400 bytes, got more"),
        (rechunked(ONE, zlib.compress(b"\7" * 400)[:-6], compression="gzip"), "400 bytes"),
        (rechunked(ONE, zlib.compress(b""), compression="gzip", shuffle=True), "400 bytes, got 0"),
        (rechunked(TWO, zlib.compress(b"\7" * 10), compression="gzip"), "400 bytes, got 10"),
        (rechunked(TWO, zlib.compress(b"\7" * 10) + bytes(4), compression="gzip", fletcher32=True), "got 10"),
        (rechunked(TWO, bytes(399), 1, compression="gzip"), "400 bytes, got 399"),
        (rechunked(ONE, b"\x01ab", **LZF), "400 bytes, got 2"),
        (rechunked(ONE, b"\x1fab", **LZF), "400 bytes, got -1"),
        (rechunked(ONE, bytes(399)), "400 bytes, got 399"),
    ],
)
def test_a_chunk_that_unpacks_to_another_size_is_never_filled_from_memory(path, make, message):
    in_place_of(path, "rf", make)
    with pytest.raises(InvalidInputError, match=rf"s\.h5: /rf.*chunk \(0, 0, 0\).*{message}"):
        all_frames(path)


def test_the_same_of_a_sensor(path):
    def make(file, name):
        node = file.create_dataset(name, data=np.arange(18.0), chunks=(18,), compression="gzip")
        node.id.write_direct_chunk((0,), zlib.compress(np.arange(17.0).tobytes()))

    in_place_of(path, "tracker/time_s", make)
    with pytest.raises(InvalidInputError, match=r"/tracker/time_s: chunk \(0,\): .*144 bytes, got 136"):
        read_sweep(path)


@pytest.mark.parametrize("chunks", [(1, 5, 40), (2, 5, 20), (6, 5, 40), (4, 3, 17)])
@pytest.mark.parametrize(
    "how",
    [{"compression": "gzip"}, {"compression": "gzip", "shuffle": True, "fletcher32": True}, LZF, {},
     {"compression": "gzip", "shuffle": True}, {"shuffle": True}],
    ids=lambda how: "-".join(how) or "plain",
)  # fmt: skip
@pytest.mark.parametrize("kind", ["<i2", ">i2", "<f4"])
def test_chunks_of_any_shape_and_filter_are_read_as_hdf5_does(path, chunks, how, kind):
    values = np.random.default_rng(0).integers(-2000, 2000, SHAPE).astype(kind)
    in_place_of(path, "rf", lambda file, name: file.create_dataset(name, data=values, chunks=chunks, **how))
    np.testing.assert_array_equal(all_frames(path), values)


@pytest.mark.parametrize("with_isal", [True, False])
def test_a_chunk_is_unpacked_alike_with_and_without_isal(monkeypatch, with_isal):
    if not with_isal:
        monkeypatch.setitem(sys.modules, "isal", None)
    packed = zlib.compress(bytes(range(200)) * 2)
    assert inflate(packed, 400, (0,)) == bytes(range(200)) * 2
    with pytest.raises(zlib.error, match="incorrect data check"):
        inflate(packed[:-1] + b"x", 400, (0,))
    with pytest.raises(InvalidInputError, match="399 bytes, got more"):
        inflate(packed, 399, (0,))
    with pytest.raises(InvalidInputError, match="expected 400 bytes"):
        inflate(packed[:-5], 400, (0,))


@pytest.mark.parametrize("size", [0, 1, 40, 300, 5000])
@pytest.mark.parametrize("levels", [2, 5, 256])
def test_the_length_of_lzf_is_that_of_what_it_packs(tmp_path, size, levels):
    values = np.random.default_rng(size).integers(0, levels, size + 400).astype(np.uint8)
    with h5py.File(tmp_path / "l.h5", "w") as file:
        node = file.create_dataset("x", data=values, chunks=values.shape, compression="lzf")
        skipped, raw = node.id.read_direct_chunk((0,))
    if not skipped:
        from speckle3d.kernels.packing import lzf_length

        packed = np.frombuffer(raw, np.uint8)
        assert lzf_length(packed) == oracles.lzf_length(raw) == values.size
        assert lzf_length(packed[:-1]) == oracles.lzf_length(raw[:-1])


def test_a_text_that_claims_four_gigabytes_is_refused_before_room_is_made(tmp_path):
    path = tmp_path / "c.h5"
    write_calibration(path, made())
    with h5py.File(path) as file:
        at = file["parameters/name"].id.get_offset()
        require_texts(file["parameters/name"])
    content = bytearray(path.read_bytes())
    content[at : at + 4] = b"\xff\xff\xff\xff"
    path.write_bytes(content)
    with pytest.raises(InvalidInputError, match=r"/parameters/name: .*4294967295"):
        read_calibration(path)


@pytest.mark.parametrize("entry", [bytes(16), b"\x01\0" + bytes(6) + b"\xff" * 8])
def test_a_heap_that_does_not_go_on_is_refused_before_hdf5_runs_in_circles(tmp_path, entry):
    path = tmp_path / "c.h5"
    write_calibration(path, made())
    content = bytearray(path.read_bytes())
    heap = content.index(b"GCOL")
    content[heap + 16 : heap + 32] = entry
    path.write_bytes(content)
    with pytest.raises(FileError, match=rf"c\.h5: heap at byte {heap}"):
        read_calibration(path)


def test_unknown_groups_with_data_elsewhere_are_not_copied(path, tmp_path):
    with h5py.File(path, "r+") as file:
        file.create_dataset("notes/deep/secret", (100,), "u1", external=[("/etc/passwd", 0, 100)])
    with pytest.raises(InvalidInputError, match=r"/etc/passwd"):
        write_sweep(tmp_path / "copy.h5", read_sweep(path))
    assert not (tmp_path / "copy.h5").exists()


def test_a_link_in_place_of_a_scans_frames_is_named(tmp_path):
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["frames"] = h5py.ExternalLink("other.h5", "/frames")
    with (
        h5py.File(tmp_path / "scan.h5") as file,
        pytest.raises(InvalidInputError, match=r"/frames: .*another file"),
    ):
        is_challenge_scan(file)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("name", ["pipe", "folder", "link", "/dev/zero"])
def test_what_is_no_file_is_refused_at_once_by_every_reader(tmp_path, name):
    from speckle3d.config import load_config
    from speckle3d.io.curves import read_curves
    from speckle3d.io.describe import describe
    from speckle3d.io.hdf5 import sha256_of
    from speckle3d.io.headers import read_header
    from speckle3d.io.load import load_sweep
    from speckle3d.io.plus_config import read_wire_phantom
    from speckle3d.io.points import read_points
    from speckle3d.io.tum import read_tum
    from speckle3d.io.voxels.volumes import read_volume
    from xsens.logs.read import read_log

    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    readers = (load_config, read_curves, describe, sha256_of, read_header, load_sweep, read_wire_phantom,
               read_points, read_tum, read_volume, read_calibration, read_sweep, read_log)  # fmt: skip
    for read in readers:
        with pytest.raises(FileError, match=name):
            read(tmp_path / name)


def test_a_text_attribute_whose_text_is_gone_is_refused(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.attrs["sensor"] = "a tracker"
    content = bytearray(path.read_bytes())
    content[content.index(b"GCOL") + 16] = 238  # the entry's number: HDF5 does not survive its absence
    path.write_bytes(content)
    with h5py.File(path) as file, pytest.raises(InvalidInputError, match=r"sensor.*9 bytes"):
        read_text(file, "sensor")


def test_a_text_attribute_written_over_is_read(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for k in range(20):
            file.attrs[f"text{k}"] = "first"
    with h5py.File(path, "r+") as file:
        for k in range(20):
            file.attrs[f"text{k}"] = f"second, longer, and number {k}"
        del file.attrs["text3"]
    with h5py.File(path) as file:
        assert [read_text(file, f"text{k}") for k in (0, 19)] == [
            "second, longer, and number 0",
            "second, longer, and number 19",
        ]


def test_an_attribute_that_is_neither_number_nor_text_is_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs.create("rms", np.zeros(1), dtype=np.dtype([("x", float)]))
    with h5py.File(tmp_path / "a.h5") as file, pytest.raises(InvalidInputError, match=r"rms.*type"):
        read_attribute(file, "rms")
