"""Checks of recording, images, curves and sensors against each other; change no estimate."""
