"""What sensors say, when, and in which frame."""
