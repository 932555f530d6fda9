"""What threads deflate is what HDF5's own filters read, in order, however small or many the frames."""

import zlib

import h5py
import numpy as np
import pytest
import sweep_examples

from speckle3d.io import deflate
from speckle3d.io.deflate import deflated, packed_by_zlib, shuffled
from speckle3d.io.sweep_writer import SweepWriter


@pytest.fixture(params=["as installed", "zlib"])
def packer(request, monkeypatch):
    if request.param == "zlib":
        monkeypatch.setattr(deflate, "_packer", lambda: packed_by_zlib)


def frames_of(kind, count=25):
    rng = np.random.default_rng(0)
    values = rng.normal(0, 300, (count, 4, 60)) * (rng.random((count, 4, 1)) < 0.7)
    return values.astype(kind)


@pytest.mark.parametrize("kind", ["int16", "float32", "uint8", "complex64"])
@pytest.mark.usefixtures("packer")
def test_hdf5_reads_what_threads_packed(tmp_path, kind):
    frames = frames_of(kind)
    sweep = {
        "uint8": sweep_examples.bmode_sweep,
        "complex64": lambda: sweep_examples.iq_sweep(paired=False),
    }.get(kind, sweep_examples.rf_sweep)()
    grid = sweep.grid.__class__(4, 60, 0.3, sweep.grid.sample_spacing_mm)
    buffer = np.empty_like(frames[0])
    with SweepWriter(tmp_path / "s.h5", grid, sweep.signal, kind) as writer:
        for i, frame in enumerate(frames):
            buffer[:] = frame  # A scanner's software may use one buffer for all frames.
            writer.append(buffer, 0.04 * i)
    with h5py.File(tmp_path / "s.h5") as file:
        (node,) = (file[name] for name in ("rf", "iq", "bmode") if name in file)
        assert (node.compression, node.shuffle, node.chunks) == ("gzip", True, (1, 4, 60))
        np.testing.assert_array_equal(node[()], frames)


@pytest.mark.usefixtures("packer")
def test_packing_is_a_zlib_stream_of_shuffled_bytes():
    frame = np.array([[0x0102, 0x0304], [0x0506, 0x0708]], ">i2")
    assert shuffled(frame).tolist() == [[1, 3, 5, 7], [2, 4, 6, 8]]
    assert zlib.decompress(deflated(shuffled(frame))) == bytes([1, 3, 5, 7, 2, 4, 6, 8])


@pytest.mark.parametrize("count", [1, 3, 65535, 65536, 200_000])
@pytest.mark.parametrize("kind", ["noise", "zeros"])
@pytest.mark.usefixtures("packer")
def test_runs_of_any_length_come_back(count, kind):
    """Noise is stored, in blocks of 65,535 bytes at most; what is alike is packed."""
    rng = np.random.default_rng(0)
    planes = rng.integers(0, 256 if kind == "noise" else 1, (2, count)).astype(np.uint8)
    packed = deflated(planes)
    assert zlib.decompress(packed) == planes.tobytes()
    # 5 bytes a block, 8 of the stream.
    assert len(packed) <= 2 * (count + 5 * (count // 65535 + 1)) + 8
    assert kind == "noise" or count < 100 or len(packed) < 0.02 * planes.size


def test_few_frames_wait_whatever_the_disk_does(tmp_path):
    """Memory stays flat: of packed frames, no more wait than the threads can take up."""
    with h5py.File(tmp_path / "s.h5", "w") as file:
        frame = np.zeros((4, 60), np.int16)
        kept = {"maxshape": (None, 4, 60), "chunks": (1, 4, 60), "compression": "gzip", "shuffle": True}
        node = file.create_dataset("rf", (0, 4, 60), "i2", **kept)
        writer, seen = deflate.DeflatingWriter(node.id, lambda: None), []
        for i in range(40):
            writer.append(frame)
            seen.append(i + 1 - node.shape[0])
        assert max(seen) <= deflate._AHEAD * deflate._MOST_THREADS
        writer.finish()
        writer.close()
        assert node.shape == (40, 4, 60)
