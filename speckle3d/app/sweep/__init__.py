"""The sweep player."""
