"""A disk that is full, without any rights: no file of this process may grow."""

import resource
from contextlib import contextmanager

FULL = "File too large"
"""What the system says then; of a disk that is full, "No space left on device"."""


@contextmanager
def limited(size):
    """Let no file of this process become larger than `size` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
