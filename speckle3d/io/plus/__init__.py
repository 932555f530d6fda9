"""Sequences of PLUS: its names of image types, orientations and transforms stay in this room."""
