"""Commands of the orientation sensor."""
