"""Whether lengths hold when the curves do not: the scenes and the rows of `bench_length.py`."""
