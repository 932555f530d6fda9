"""Readers survive whatever a file holds: samples or one line of error.

``corpus/`` keeps inputs worth trying again: each reaches a part of the readers that no other does, or once
broke one. ``corpus/make.py`` writes those that are made; add by hand what is found.
"""

from pathlib import Path

import numpy as np
import pytest

from speckle3d.core.errors import Speckle3DError
from xsens.logs.datamessages import parse_stream
from xsens.logs.read import read_log
from xsens.logs.samples import VECTORS, ImuLog

CORPUS = sorted((Path(__file__).parent / "corpus").glob("*.bin"))
assert CORPUS, "the corpus lies beside this file"


def outcome(read, data):
    """What a reader returns, or its error."""
    try:
        return read(data)
    except Speckle3DError as error:
        return error


def survives(read, data):
    """Samples that are valid, or one line of error; nothing else, and no warning."""
    log = outcome(read, data)
    if isinstance(log, Speckle3DError):
        assert 0 < len(str(log)) < 500
        assert "\n" not in str(log)
        return
    assert isinstance(log, ImuLog)
    assert (np.diff(log.time_s) > 0).all()
    for name in VECTORS:
        vectors = getattr(log, name)
        assert vectors is None or (np.isnan(vectors) | (np.abs(vectors) < 1e6)).all()


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.stem)
def test_the_corpus_raises_only_our_errors(path):
    survives(read_log, path)
    survives(parse_stream, path.read_bytes())
