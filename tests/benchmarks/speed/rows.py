"""One row of the table: what was timed, beside a peer or a limit of the same process."""

import statistics
import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One figure.

    Attributes
    ----------
    value, peer_value : float
        In `unit`.
    peer : str
        What `value` is beside; empty if there is no peer in the process.
    target : float or None
        At least this, or for seconds and shares, for which `falling` is set, at most.
    cores : float or None
        How many the work kept busy: processor time over time.
    """

    label: str
    value: float
    unit: str
    peer: str = ""
    peer_value: float = float("nan")
    target: float | None = None
    falling: bool = False
    cores: float | None = None

    @property
    def times_peer(self):
        """How many times as fast as the peer."""
        return self.peer_value / self.value if self.falling else self.value / self.peer_value

    @property
    def misses_target(self):
        """Whether the target is."""
        if self.target is None:
            return False
        return self.value > self.target if self.falling else self.value < self.target

    def cells(self):
        """Text of the table's columns."""
        bound = "" if self.target is None else f"{'<=' if self.falling else '>='} {self.target:g}"
        return (
            self.label,
            f"{self.value:.3g} {self.unit}" + (" !" if self.misses_target else ""),
            bound,
            "" if self.cores is None else f"{self.cores:.2f}",
            f"{self.peer}: {self.peer_value:.3g}" if self.peer else "",
            f"{self.times_peer:.3g}" if self.peer else "",
        )


HEADINGS = ("", "measured", "target", "cores busy", "peer or limit", "times as fast")


def print_table(rows):
    """Print rows as a table in Markdown, so that it can be put on a page."""
    cells = [HEADINGS, *(row.cells() for row in rows)]
    widths = [max(len(line[k]) for line in cells) for k in range(len(HEADINGS))]
    lines = [
        "| " + " | ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) + " |" for line in cells
    ]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    print("\n".join(lines), flush=True)


@dataclass(frozen=True)
class Timing:
    """Median seconds of several runs and the processors they kept busy."""

    seconds: float
    cores: float


def time_runs(function, runs):
    """Time a function, after one run in which kernels are loaded."""
    function()
    walls, busy = [], []
    for _ in range(runs):
        start_s, cpu_s = time.perf_counter(), time.process_time()
        function()
        walls.append(time.perf_counter() - start_s)
        busy.append((time.process_time() - cpu_s) / walls[-1])
    return Timing(statistics.median(walls), statistics.median(busy))
