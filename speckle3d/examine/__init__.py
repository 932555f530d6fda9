"""What a recording, its images and its curves say against each other; changes no estimate."""
