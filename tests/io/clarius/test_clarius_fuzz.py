"""Whatever a damaged package holds, it is read, or refused in one line."""

import clarius_examples as examples
import numpy as np
import pytest
from clarius_examples import GIVEN, sweep_of

from speckle3d.core.errors import Speckle3DError
from speckle3d.io.describe import describe
from speckle3d.io.load import load_sweep

TOKENS = (
    b"{",
    b"}",
    b"[",
    b"-",
    b": ",
    b"\n",
    b"999999999999",
    b"-1",
    b"nan",
    b"*a",
    b"&a ",
    b"!!python/x ",
    b"\0",
)


def damaged(content, rng):
    """A few bytes changed, cut out, or words put in, that a text may have."""
    spoiled = bytearray(content)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, max(len(spoiled), 1)))
        match int(rng.integers(0, 4)):
            case 0:
                spoiled[at : at + 1] = rng.bytes(1)
            case 1:
                del spoiled[at : at + int(rng.integers(1, 40))]
            case 2:
                spoiled[at:at] = TOKENS[int(rng.integers(0, len(TOKENS)))]
            case _:
                del spoiled[at + 1 :]
    return bytes(spoiled)


def told(path):
    """Messages of what is refused, reading the frames and describing the package."""
    for act in (lambda: load_sweep(path, GIVEN).frames[0], lambda: describe(path)):
        try:
            act()
        except Speckle3DError as error:
            yield str(error)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["_rf.yml", "_imu.yml", "_rf.tgc", "_rf.raw.lzo", ".tar"])
def test_damaged_files_are_told_in_a_line(tmp_path, kind):
    rng = np.random.default_rng(7)
    files = examples.package_files(sweep_of("rf"), packed=True)
    whole = examples.write_files(tmp_path / "whole.tar", files).read_bytes()
    for i in range(150):
        target = tmp_path / f"p{i}{'.tar' if kind == '.tar' else ''}"
        if kind == ".tar":
            target.write_bytes(damaged(whole, rng))
        else:
            name = next(each for each in files if each.endswith(kind))
            examples.write_files(target, files | {name: damaged(files[name], rng)})
        assert all("\n" not in each and str(target) in each for each in told(target))
