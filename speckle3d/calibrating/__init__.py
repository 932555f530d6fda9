"""Calibration with phantoms as commands and the app do it: recordings, settings, solutions, files written."""
