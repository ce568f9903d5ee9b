"""Runs: processes, their files, live tables."""
