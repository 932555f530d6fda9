"""One estimate from all that is known: images, orientation sensor, tracker and evidence of the scale."""
