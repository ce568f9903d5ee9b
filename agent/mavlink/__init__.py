"""The autopilot's side: bytes, session, clocks, rates and signing."""
