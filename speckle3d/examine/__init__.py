"""What is odd about a recording, how odd, and what that rests on. Nothing here changes an estimate."""
