"""Fake autopilots, as strict as the real ones."""
