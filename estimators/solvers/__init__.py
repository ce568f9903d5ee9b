"""Minimisers: Gauss-Newton, the compiled active set, quadratic programs and their engines."""
