"""Trials of calibrations against truth, one module for each kind; `bench_calibration_errors.py` runs them."""
