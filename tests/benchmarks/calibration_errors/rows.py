"""What a kind of calibration measures of itself: a row with its target, and the shares that rows show."""

import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context

import numpy as np


@dataclass(frozen=True)
class Row:
    """One line of the table: figures with their units, beside what they should reach."""

    case: str
    found: str
    target: str
    reached: bool


def coverage_row(case, ratio):
    """Coverage of 68 % and 95 % intervals by errors over claims, against 62 to 74 and 92 to 98 %."""
    one, two = (100.0 * np.mean(np.abs(ratio) < limit) for limit in (1.0, 1.96))
    found = f"{one:.0f} / {two:.0f} %, RMS z {np.sqrt(np.mean(ratio**2)):.2f}, {ratio.size} figures"
    return Row(case, found, "62-74 / 92-98 %", bool(62.0 <= one <= 74.0 and 92.0 <= two <= 98.0))


def trials(run, todo):
    """Run a function of this kind of trial on all cores, in order."""
    return list(_pool().map(run, todo, chunksize=4))


@cache
def _pool():
    """Processes that are started once: each loads everything, for seconds."""
    return ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn"))
