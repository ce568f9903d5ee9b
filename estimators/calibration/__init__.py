"""What sensors get wrong and flight data can correct: their latency."""
