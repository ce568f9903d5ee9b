"""The measurement window, its accelerations, and the least-squares problem made of it."""
