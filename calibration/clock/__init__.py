"""The delay between images and a sensor."""
