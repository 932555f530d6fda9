"""A study as one page: data, figures, page."""
