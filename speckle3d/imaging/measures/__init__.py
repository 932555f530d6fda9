"""Surfaces, lengths, areas and volumes with their standard errors."""
