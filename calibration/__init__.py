"""Where the image is relative to the sensor."""
