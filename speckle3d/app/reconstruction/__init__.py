"""The reconstruction viewer."""
