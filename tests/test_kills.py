"""A few of the moments of `tests/benchmarks/bench_kill.py`."""

import os

import pytest
from benchmarks import bench_kill


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals as POSIX has them")
def test_killed_at_random_moments_commands_leave_one_result_and_the_next_run_makes_it_whole():
    assert bench_kill.main(5, 5, ("reconstruct over results",)) == 0
