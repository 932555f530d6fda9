"""What is placed in space as files: surfaces, lines, transforms, picked points."""
