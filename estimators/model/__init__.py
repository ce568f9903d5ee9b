"""What is estimated and measured: the state, how it moves, measurement rows with value, gradient and bound."""
