"""Errors of orientation against a reference."""
