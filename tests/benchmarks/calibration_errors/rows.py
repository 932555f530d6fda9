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
    figures: str
    target: str
    is_on_target: bool


def coverage_row(case, ratio):
    """Coverage of 68 % and 95 % intervals by errors over claims, against 62 to 74 and 92 to 98 %.

    It is missed where it is outside by two standard errors of so many figures: few trials tell little.
    """
    shares = np.array([np.mean(np.abs(ratio) < limit) for limit in (1.0, 1.96)])
    slack = 2.0 * np.sqrt(np.array([0.68 * 0.32, 0.95 * 0.05]) / ratio.size)
    figures = "{:.0f} / {:.0f} %".format(*(100.0 * shares))
    figures += f", RMS z {np.sqrt(np.mean(ratio**2)):.2f}, {ratio.size} figures of {len(ratio)} trials"
    is_on_target = (shares >= np.array([0.62, 0.92]) - slack) & (shares <= np.array([0.74, 0.98]) + slack)
    target = "62-74 / 92-98 %, +- {:.0f} / {:.0f} % for so many figures".format(*(100.0 * slack))
    return Row(case, figures, target, bool(is_on_target.all()))


def trials(run, todo):
    """Run a function of this kind of trial on all cores, in order."""
    return list(_pool().map(run, todo, chunksize=4))


@cache
def _pool():
    """Processes that are started once: each loads everything, for seconds."""
    return ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn"))
