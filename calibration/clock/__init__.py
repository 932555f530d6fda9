"""Clock offset between images and a sensor."""
