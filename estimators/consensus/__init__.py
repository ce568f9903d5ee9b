"""What neighbours exchange about the past: information pairs, weights, inheritance."""
