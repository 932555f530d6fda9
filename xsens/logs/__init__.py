"""Files and streams of the sensor to samples on one clock."""
