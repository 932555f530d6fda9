"""A row of the benchmark's table."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One case as measured, beside what it should reach."""

    case: str
    figures: str
    target: str


def show(rows: list[Row]) -> None:
    """Print rows under each other."""
    for row in rows:
        print(f"  {row.case}\n      {row.figures}\n      target: {row.target}", flush=True)
