"""Text from outside reaches a terminal, an error and a table escaped."""

import pickle

import pytest

from speckle3d.core.errors import FileError, InvalidInputError, naming

HOSTILE = "a\x1b[31m\r\n\x9b\u202e\u2028\udc80\x00b"
ESCAPES = r"a\x1b[31m\r\n\x9b\u202e\u2028\udc80\x00b"


@pytest.mark.parametrize("kind", [InvalidInputError, FileError])
def test_an_error_is_one_line_whatever_it_quotes(kind):
    error = kind(f"{HOSTILE}: expected a")
    assert str(error) == f"{ESCAPES}: expected a"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    with pytest.raises(kind) as info, naming(HOSTILE):
        raise kind(f"{HOSTILE}: expected a")
    assert str(info.value) == str(error)
