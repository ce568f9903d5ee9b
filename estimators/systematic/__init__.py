"""Systematic errors of the sensors: which there are, how large they are, and where they enter a window's rows."""
