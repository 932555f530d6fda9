"""The tuners of what is found in recordings of phantoms."""
