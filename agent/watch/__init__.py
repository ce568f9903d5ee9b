"""What a daemon tells those who look after it."""
