"""Recordings of other systems, a module each, and what they share."""
