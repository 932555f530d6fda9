"""The check of an orientation sensor."""
