"""The bridge to real autopilot firmware in simulators."""
