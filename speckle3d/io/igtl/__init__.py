"""OpenIGTLink: messages, and the two ends of a connection."""
