"""What a recording, its images, curves and sensors say against each other; changes no estimate."""
