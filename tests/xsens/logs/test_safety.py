"""Readers survive whatever a file holds: samples or one line of error.

``corpus/`` keeps inputs worth trying again: each reaches a part of the readers that no other does, or once
broke one. ``corpus/make.py`` writes those that are made; add by hand what is found.
"""

from pathlib import Path

import numpy as np
import pytest
from imu_logs import calibration, configured, legacy_messages, mt9_bin, mtdata2_messages, samples

from speckle3d.core.errors import Speckle3DError
from xsens.logs.read import parse_stream, read_log
from xsens.logs.samples import ImuLog
from xsens.messages.framing import find_frames
from xsens.messages.mtdata import DataLayout, OutputMode, OutputSettings

CORPUS = sorted((Path(__file__).parent / "corpus").glob("*.bin"))
assert CORPUS, "the corpus lies beside this file"


def outcome(read, data):
    """What a reader returns, or its error."""
    try:
        return read(data)
    except Speckle3DError as error:
        return error


def assert_one_line(error):
    assert str(error)
    assert "\n" not in str(error)
    assert len(str(error)) < 500


def survives(data, tmp_path=None):
    """Samples that are valid, or None after one line of error; nothing else, and no warning."""
    if tmp_path is None:
        log = outcome(parse_stream, data)
    else:
        (tmp_path / "log").write_bytes(data)
        log = outcome(read_log, tmp_path / "log")
    if isinstance(log, Speckle3DError):
        assert_one_line(log)
        return None
    assert isinstance(log, ImuLog)
    assert (np.diff(log.time_s) > 0).all()
    for name in ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au"):
        vectors = getattr(log, name)
        assert vectors is None or (np.isnan(vectors) | (np.abs(vectors) < 1e6)).all()
    return log


def streams():
    s = samples(8)
    layout = DataLayout(
        OutputMode.CALIBRATED | OutputMode.ORIENTATION | OutputMode.STATUS,
        OutputSettings.COUNTER | OutputSettings.MATRIX,
    )
    return {
        "mt9": mt9_bin(s, calibration()),
        "legacy": configured(layout) + b"".join(legacy_messages(s, layout)),
        "mtdata2": b"".join(mtdata2_messages(s, form=2)),
    }


STREAMS = streams()


@pytest.mark.parametrize("kind", STREAMS)
def test_every_single_bit_flipped_costs_one_message_at_most(kind):
    data = STREAMS[kind]
    whole = set(find_frames(data).messages())
    rng = np.random.default_rng(0)
    for bit in rng.choice(8 * len(data), 400, replace=False):
        spoiled = bytearray(data)
        spoiled[bit // 8] ^= 1 << bit % 8
        survives(bytes(spoiled))
        kept = set(find_frames(bytes(spoiled)).messages())
        assert len(whole - kept) <= 1, bit


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.stem)
def test_the_corpus_is_survived(path, tmp_path):
    data = path.read_bytes()
    survives(data, tmp_path)
    survives(data)
    assert sum(p.stat().st_size for p in CORPUS) < 200_000
