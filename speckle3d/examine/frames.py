"""Frames that cannot be placed: how many there may be, and how they are told."""

from textwrap import shorten

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.matching.quality import FrameFlag, short_repeats

LARGEST_LOSS = 0.3
"""Share of frames that may not be placed; with more, lengths are mostly guesses."""

_WORDS = {
    FrameFlag.FROZEN: "the same as the one before",
    FrameFlag.SATURATED: "saturated, poses guessed",
    FrameFlag.LIFTED: "with the probe lifted, poses guessed",
    FrameFlag.NO_SPECKLE: "without speckle, poses guessed",
    FrameFlag.UNMATCHED: "unlike any earlier one, poses guessed",
}


def placed_flags(flags: IntArray, loose: BoolArray | bool = False) -> IntArray:
    """Flags of all frames, with those that no pair joins to earlier ones.

    Raises
    ------
    InsufficientDataError
        If too many frames, but for short repeats, have a flag.
    """
    flags = np.where(loose & (flags == 0), int(FrameFlag.UNMATCHED), flags)
    own = flags[~short_repeats(flags)]
    count = np.count_nonzero(own)
    if count > LARGEST_LOSS * own.size:
        raise InsufficientDataError(
            f"expected frames with speckle in common, got {count} of {own.size} that cannot be placed: "
            f"{'; '.join(describe(flags))}"
        )
    return flags


def describe(flags: npt.ArrayLike) -> list[str]:
    """Tell the flagged frames, a line for every kind of flag: how many, and the first of them."""
    values = np.asarray(flags, dtype=np.int64)
    lines = []
    for flag, words in _WORDS.items():
        frames = np.flatnonzero(values & int(flag)).tolist()
        if frames:
            numbers = shorten(", ".join(map(str, frames)), 40, placeholder=" ...")
            lines.append(f"{len(frames)} frame{'s' * (len(frames) > 1)} {words}: {numbers}")
    return lines
