"""Packages cannot reach outside themselves, and several recordings are told apart."""

import io
import os
import tarfile

import clarius_examples as examples
import pytest
from sweep_examples import rf_sweep

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.io.clarius.package import find_recording, is_package
from speckle3d.io.describe import describe
from speckle3d.io.readers import find_reader, first_bytes


def files():
    return examples.package_files(rf_sweep(2, 3, 8), sensor=False)


def claimed(path):
    return is_package(path, first_bytes(path))


def tar_of(path, *entries):
    with tarfile.open(path, "w") as archive:
        for entry, content in entries:
            archive.addfile(entry, io.BytesIO(content))
    return path


def entry(name, kind=tarfile.REGTYPE, link="", size=0):
    made = tarfile.TarInfo(name)
    made.type, made.linkname, made.size = kind, link, size
    return made


def test_packages_are_claimed_by_what_is_in_them(tmp_path):
    folder = examples.write_files(tmp_path / "folder", files())
    tar = examples.write_files(tmp_path / "package.tar", files())
    renamed = tmp_path / "no suffix"
    renamed.write_bytes(tar.read_bytes())
    raw = next(folder.glob("*.raw"))
    for path in (folder, tar, renamed, raw):
        assert claimed(path), path
        assert find_reader(path).format == "Clarius raw package"
    other = tar_of(tmp_path / "other.tar", (entry("readme.txt"), b""))
    lone = tmp_path / "x_rf.raw"
    lone.write_bytes(b"no yml")
    empty = tmp_path / "empty"
    empty.mkdir()
    damaged = tmp_path / "damaged.tar"
    damaged.write_bytes(b"\0" * 100 + b"x" * 900)
    for path in (other, lone, empty, damaged):
        assert not claimed(path), path


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (entry("../x_rf.yml"), "expected members inside the package"),
        (entry("/x_rf.yml"), "expected members inside the package"),
        (entry("a/../../x_rf.yml"), "expected members inside the package"),
        (entry("C:\\x_rf.yml"), "expected members inside the package"),
        (entry("x_rf.tgc", tarfile.SYMTYPE, "/etc/passwd"), "expected a file, got a link to '/etc/passwd'"),
        (entry("x_rf.tgc", tarfile.LNKTYPE, "x_rf.yml"), "expected a file, got a link"),
        (entry("x_rf.tgc", tarfile.FIFOTYPE), "expected a plain file, got a device"),
        (entry("x_rf.tgc", tarfile.CHRTYPE), "expected a plain file, got a device"),
    ],
)
def test_members_that_reach_outside_are_refused(tmp_path, bad, message):
    path = tar_of(tmp_path / "p.tar", (entry("x_rf.raw"), b""), (bad, b""))
    with pytest.raises(InvalidInputError, match=message):
        find_recording(path)


def test_links_out_of_a_folder_are_refused(tmp_path):
    folder = examples.write_files(tmp_path / "folder", files())
    outside = tmp_path / "outside.yml"
    outside.write_text("x")
    os.symlink(outside, folder / f"{examples.NAME}_imu.yml")
    with pytest.raises(InvalidInputError, match="expected a file in the package's own folder, got a link"):
        find_recording(folder)


def test_truncated_tar_files_are_named(tmp_path):
    tar = examples.write_files(tmp_path / "p.tar", files())
    for size in (700, 1100, 1800):
        tar.write_bytes(tar.read_bytes()[:size])
        with pytest.raises((FileError, InvalidInputError)) as caught:
            find_recording(tar)
        assert str(tar) in str(caught.value)


def test_several_recordings_are_named_and_one_is_chosen_by_its_raw_file(tmp_path):
    second = {name.replace("2024", "2025"): content for name, content in files().items()}
    folder = examples.write_files(tmp_path / "folder", files() | second)
    with pytest.raises(InvalidInputError, match=r"got 2: 2024.*, 2025.*: give the raw file of one"):
        find_recording(folder)
    chosen = find_recording(folder / f"{examples.NAME}_rf.raw")
    assert chosen.name == examples.NAME
    assert set(chosen.raw) == set(chosen.settings) == set(chosen.gains) == {"rf"}


def test_two_raw_files_of_a_kind_are_named(tmp_path):
    both = files() | {f"{examples.NAME}_rf.raw.lzo": b"x"}
    folder = examples.write_files(tmp_path / "folder", both)
    with pytest.raises(InvalidInputError, match=r"expected one of .*_rf\.raw and .*_rf\.raw\.lzo, got both"):
        find_recording(folder)


def test_a_raw_file_without_yml_is_named(tmp_path):
    from speckle3d.io.load import load_sweep

    bare = {name: content for name, content in files().items() if not name.endswith(".yml")}
    folder = examples.write_files(tmp_path / "folder", bare)
    with pytest.raises(InvalidInputError, match=r"_rf\.raw: expected 2024.*_rf\.yml beside it, got none"):
        load_sweep(folder)


def test_a_tar_file_without_its_end_is_told(tmp_path):
    tar = examples.write_files(tmp_path / "p.tar", files())
    whole = tar.read_bytes()
    with tarfile.open(tar) as archive:
        last = archive.getmembers()[-1]
    end = last.offset_data + -(-last.size // 512) * 512
    assert not find_recording(tar).cut
    tar.write_bytes(whole[:end])
    assert find_recording(tar).cut
    assert any("without the blocks that close" in row[1] for row in describe(tar))
    for tail in (b"x" * 100, b"x" * 512):
        tar.write_bytes(whole[:end] + tail)
        with pytest.raises(FileError, match=rf"end at byte {end}, got"):
            find_recording(tar)


def test_two_files_of_the_sensor_are_named(tmp_path):
    both = files() | {f"{examples.NAME}_imu.{end}": b"timestamp: 1" for end in ("yml", "yaml")}
    folder = examples.write_files(tmp_path / "folder", both)
    with pytest.raises(InvalidInputError, match=r"expected one of .*_imu\.yaml and .*_imu\.yml, got both"):
        find_recording(folder)


def test_other_files_of_such_names_are_no_package(tmp_path):
    other = {"my_env.yml": b"name: work\ndependencies:\n  - numpy\n"}
    folder = examples.write_files(tmp_path / "conda", other)
    for path in (folder, folder / "my_env.yml", examples.write_files(tmp_path / "conda.tar", other)):
        assert not claimed(path), path
    mixed = examples.write_files(tmp_path / "mixed", files() | other)
    assert claimed(mixed)
    assert find_recording(mixed).name == examples.NAME
