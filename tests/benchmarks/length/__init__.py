"""Whether lengths hold when the curves do not: the two parts of `bench_length.py`."""
