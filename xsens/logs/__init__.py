"""From files to samples on one clock."""
