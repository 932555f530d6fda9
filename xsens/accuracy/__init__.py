"""Errors of orientation against a reference: angles between frames, streams, figures."""
