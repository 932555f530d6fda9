"""Errors of a reconstruction against a reference: lengths, displacements, statistics."""
