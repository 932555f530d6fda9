"""What a kind of calibration measures of itself: a row with its target, and the shares that rows show."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from typing import TypeVar

import numpy as np

Trial = TypeVar("Trial")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    case : str
    found : str
        Figures with their units.
    target : str
    reached : bool
    """

    case: str
    found: str
    target: str
    reached: bool


def coverage(errors: np.ndarray, claimed: np.ndarray) -> tuple[float, float]:
    """Percent of errors within one and within 1.96 claimed standard errors."""
    ratio = np.abs(np.asarray(errors)) / np.asarray(claimed)
    return 100.0 * float(np.mean(ratio < 1.0)), 100.0 * float(np.mean(ratio < 1.96))


def coverage_row(case: str, errors: np.ndarray, claimed: np.ndarray) -> Row:
    """Coverage of 68 % and 95 % intervals against 62 to 74 and 92 to 98 %."""
    one, two = coverage(errors, claimed)
    rms = float(np.sqrt(np.mean((np.asarray(errors) / np.asarray(claimed)) ** 2)))
    reached = 62.0 <= one <= 74.0 and 92.0 <= two <= 98.0
    found = f"{one:.0f} / {two:.0f} %, RMS z {rms:.2f}, {len(np.ravel(errors))} figures"
    return Row(case, found, "62-74 / 92-98 %", reached)


def trials(run: Callable[[Trial], Result], todo: Iterable[Trial]) -> list[Result]:
    """Run a function of this kind of trial on all cores, in order."""
    return list(_pool().map(run, todo, chunksize=4))


@cache
def _pool() -> ProcessPoolExecutor:
    """Processes that are started once: each loads everything, for seconds."""
    return ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn"))
