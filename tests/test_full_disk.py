"""Every writer on a full disk: one line that names the file and the reason, and the old file as it was."""

import resource
import subprocess
import sys
from contextlib import closing, contextmanager

import imu_logs
import numpy as np
import pytest
import sweep_examples
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import NoSpaceError
from speckle3d.core.volume import Volume
from speckle3d.io.family.sweep_writer import attach_orientation, write_sweep
from speckle3d.io.plus.write import write_sequence
from speckle3d.io.voxels.volumes import write_volume
from speckle3d.study.results import write_texts
from xsens.live.recording import RawFile
from xsens.logs.datamessages import parse_stream
from xsens.logs.textlogs import write_csv

FULL = "File too large"
"""What the system says where no file of a process may grow; of a disk, "No space left on device"."""
SWEEP = sweep_examples.rf_sweep()
VOLUME = Volume(
    np.random.default_rng(0).integers(0, 255, (20, 15, 10)).astype(np.uint8),
    (0.5, 0.5, 1.0),
    RigidTransform.identity(),
)


@contextmanager
def file_size_limit(size):
    """Let no file of this process become larger than `size` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


WRITERS = {
    "sweep.h5": lambda path: write_sweep(path, SWEEP),
    "sequence.mha": lambda path: write_sequence(path, SWEEP, compressed=False),
    "attached.h5": lambda path: attach_orientation(path, SWEEP.orientation),
    "volume.nii.gz": lambda path: write_volume(path, VOLUME),
    "summary.json": lambda path: write_texts(path.parent, {path.name: "0123456789" * 500}),
    "log.csv": lambda path: write_csv(
        path, parse_stream(b"".join(imu_logs.mtdata2_messages(imu_logs.samples())))
    ),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_line_and_the_old_file_stays(tmp_path, name, capfd):
    path = tmp_path / name
    if name == "attached.h5":
        write_sweep(path, SWEEP)
    WRITERS[name](path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    size = len(before[name])
    # The last bytes are those that are lost silently: they are written when the file is closed.
    for room in (size // 2, size - 1):
        with file_size_limit(room), pytest.raises(NoSpaceError, match=FULL) as error:
            WRITERS[name](path)
        assert str(path) in str(error.value)
        assert "\n" not in str(error.value)
        assert ".part-" not in str(error.value)
        assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
    assert capfd.readouterr().err == ""


def test_a_recording_keeps_what_fitted(tmp_path):
    with (
        file_size_limit(1200),
        closing(RawFile(tmp_path / "r.mtb")) as file,
        pytest.raises(NoSpaceError, match=FULL),
    ):
        file.append(bytes(50000))
    assert (tmp_path / "r.mtb").stat().st_size == 1200


COMMAND = """
import resource, sys
from speckle3d.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (16_000, -1))
main()
"""


def test_the_command_ends_with_one_line_and_no_crash(data_folder, tmp_path):
    arguments = ("convert", str(data_folder / "phantom.h5"), str(tmp_path / "copy.h5"))
    process = subprocess.run(
        [sys.executable, "-c", COMMAND, *arguments], capture_output=True, text=True, timeout=60
    )
    assert process.returncode == 1
    assert process.stderr.splitlines()[-1] == f"speckle3d: {tmp_path / 'copy.h5'}: cannot be written: {FULL}"
    assert list(tmp_path.iterdir()) == []
