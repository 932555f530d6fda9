"""Between bytes and messages."""
