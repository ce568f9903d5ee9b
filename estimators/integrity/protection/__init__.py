"""What is promised of a position besides the estimate: `levels` of protection, and the `statement` of a tick."""
