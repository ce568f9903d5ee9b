"""The UWB module's side: ``uwb-range/1`` frames to samples, and in `modules` what modules say to frames."""
