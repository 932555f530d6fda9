"""Surfaces, lengths, areas and volumes, and how far they may be off."""
