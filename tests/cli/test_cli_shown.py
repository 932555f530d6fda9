"""Names from outside reach terminal, folders and pictures as text: no escape sequence, line or markup."""

import json
import os
import shutil
import sys
from dataclasses import replace

import h5py
import pytest
from calibration_files import example_calibration

from speckle3d.io.family.calibrations import write_calibration

HOSTILE = "a\x1b]0;gone\x07\x1b[31m\n\u202e[red]{0}$x^$<script>"
SHOWN = "a\\x1b]0;gone\\x07\\x1b[31m\\n\\u202e[red]{0}$x^$<script>"


def is_plain(text):
    return all(line.isprintable() for line in text.split("\n"))


def test_what_a_file_says_of_itself_is_shown_escaped_and_json_stays_json(run, tmp_path):
    path = tmp_path / "c.h5"
    write_calibration(path, replace(example_calibration(), verdict=HOSTILE))
    with h5py.File(path, "r+") as file:
        file["frames/reason"][0] = HOSTILE
    code, out, _ = run("info", path)
    assert code == 0
    assert SHOWN in out
    assert is_plain(out)
    assert SHOWN in run("info", tmp_path / HOSTILE)[2]
    code, out, _ = run("info", path, "--json")
    assert HOSTILE in {row["value"] for row in json.loads(out)}
    assert is_plain(out)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_a_sweep_may_have_any_name(run, tmp_path, small_sweeps):
    # A name that is no Unicode, too.
    name = os.fsdecode(os.fsencode(HOSTILE.replace("/", "")) + b"\xff")
    shutil.copy(small_sweeps / "s5.h5", tmp_path / f"{name}.h5")
    code, out, err = run(
        "reconstruct", tmp_path / f"{name}.h5", "-o", tmp_path / "out", "--curves", small_sweeps / "curves.h5"
    )
    assert code == 0, err
    assert is_plain(out + err)
    assert is_plain((tmp_path / "out" / "table.txt").read_text(encoding="utf-8"))
