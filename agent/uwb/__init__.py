"""The UWB module's side."""
