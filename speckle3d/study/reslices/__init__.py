"""Where a sweep is cut, what shows there in every mode, and its figures."""
