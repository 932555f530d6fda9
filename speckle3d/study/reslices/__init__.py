"""Cuts of a sweep in every mode, and their figures."""
