"""Damaged files of every kind that is read: read, or refused in one line; no traceback, crash or hang.

``python tests/fuzz/test_fuzz.py KIND FIRST COUNT`` does some cases of a kind in this process.
"""

import faulthandler
import resource
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

CASES = 100
MEMORY_BYTES, CASE_S = 2**31, 60
"""Room for the package and what it loads, and a hundred times what a case takes."""

IMPORT = """
sampling_rate_hz = 40e6
vector_pitch_mm = 0.3
centre_frequency_hz = 6e6
bandwidth_hz = [4e6, 8e6]
frame_rate_hz = 20
column_pitch_mm = 0.1
row_spacing_mm = 0.1
dynamic_range_db = 60
"""


def write_family(folder):
    import old_files

    old_files.write_all(folder)


def write_images(folder):
    import image_examples
    from old_files import sweeps

    from speckle3d.io.plus.write import write_sequence

    image_examples.write_mha(
        folder / "a.mha", image_examples.grey(), frames=image_examples.frame_fields(3)[2]
    )
    write_sequence(folder / "b.nrrd", sweeps()["bmode"][0])


def write_shapes(folder):
    from old_files import POSES

    from speckle3d.core.surface import Surface
    from speckle3d.core.volume import STATE_SEGMENTS, LabelMap
    from speckle3d.io import shapes
    from speckle3d.io.points import PickedPoints, write_points
    from speckle3d.io.tum import write_tum
    from speckle3d.io.voxels.volumes import SUFFIXES, write_volume

    place = np.arange(120, dtype=np.uint8).reshape(4, 5, 6) % 3, (0.5, 0.25, 1.0), POSES[1], {"a": "b"}
    for suffix in (".seg.nrrd", *SUFFIXES):
        write_volume(folder / f"v{suffix}", LabelMap(*place, STATE_SEGMENTS))
    for suffix in shapes.SUFFIXES:
        surface = Surface(np.eye(4)[:, :3], np.array([[0, 1, 2], [0, 2, 3]]))
        shapes.write_surface(folder / f"s{suffix}", surface)
    write_tum(folder / "t.tum", np.arange(4) / 10, POSES)
    write_points(folder / "p.csv", PickedPoints(np.arange(3), np.arange(6.0).reshape(3, 2)))


def write_others(folder):
    import format_examples as examples

    examples.write_uff(folder / "a.uff", examples.iq(), 6e6)
    examples.write_zea(folder / "b.hdf5", examples.iq())
    for new in (False, True):
        examples.write_mat(folder / f"{new:d}.mat", new, RcvData=examples.matlab_order(examples.rf()))
    examples.write_dicom(folder / "d.dcm", examples.grey(), PixelSpacing=[0.1, 0.2])
    examples.write_ultrasonix(folder / "e.rf", examples.rf())
    np.save(folder / "f.npy", examples.grey())


KINDS = {kind.__name__[6:]: kind for kind in (write_family, write_images, write_shapes, write_others)}
RECORDS = {"curves", "calibration", "reconstruction"}


def read(path):
    """Read all of a file, as its users would."""
    from speckle3d.cli.describe import describe
    from speckle3d.io.load import load_sweep
    from speckle3d.io.points import read_points
    from speckle3d.io.shapes import SUFFIXES, read_surface
    from speckle3d.io.tum import read_tum

    readers = {".tum": read_tum, ".csv": read_points, **dict.fromkeys(SUFFIXES, read_surface)}
    readers.get(path.suffix, describe)(path)
    if path.parent.name != "shapes" and not RECORDS & {path.stem.split("_")[0]}:
        sweep = load_sweep(path)
        for i in range(len(sweep)):
            sweep.frames[i]


def damage(content, rng):
    """Bytes with a few changed, a run of zeros in them, or cut off."""
    how, data = rng.integers(0, 6), bytearray(content)
    at, length = int(rng.integers(0, len(data))), int(rng.integers(1, 64))
    if how == 0:
        del data[at:]
    elif how == 1:
        del data[at : at + length]
    elif how == 2:
        data[at : at + length] = bytes(len(data[at : at + length]))
    else:  # structures lie at the beginning more often than elsewhere
        for _ in range(int(rng.integers(1, 9))):
            data[int(rng.integers(0, min(len(data), 2048 if how == 5 else len(data))))] = int(
                rng.integers(0, 256)
            )
    return bytes(data)


def run(kind, first, count):
    """Do some cases and print each seed before its case; an exception that is not the package's ends it."""
    from speckle3d.core.errors import Speckle3DError

    faulthandler.enable()
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", UserWarning)  # the package's own, of rows left out
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / kind
        folder.mkdir()
        KINDS[kind](folder)
        paths = sorted(path for path in folder.iterdir() if path.suffix not in (".raw", ".zraw"))
        if kind in ("images", "others"):
            (folder / "import.toml").write_text(IMPORT)
        for path in paths:
            if kind != "others":
                read(path)  # whole ones are read
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        whole = {path: path.read_bytes() for path in paths}
        for seed in range(first, first + count):
            print(seed, flush=True)
            rng = np.random.default_rng([*kind.encode(), seed])
            path = paths[int(rng.integers(0, len(paths)))]
            path.write_bytes(damage(whole[path], rng))
            faulthandler.dump_traceback_later(CASE_S, exit=True)
            try:
                read(path)
            except Speckle3DError as error:
                if "\n" in str(error):
                    raise AssertionError(f"expected one line, got {error!r}") from error
            path.write_bytes(whole[path])
        faulthandler.cancel_dump_traceback_later()


@pytest.mark.parametrize("kind", KINDS)
def test_damage_is_read_or_refused_in_one_line(kind):
    command = [sys.executable, __file__, kind, "0", str(CASES)]
    process = subprocess.run(command, capture_output=True, text=True, timeout=900)
    last = process.stdout.split()[-1:]
    assert process.returncode == 0, f"{kind}: case {last}:\n{process.stderr[-3000:]}"


if __name__ == "__main__":
    run(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
