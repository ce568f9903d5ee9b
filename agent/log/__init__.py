"""What a daemon keeps of its run: estimate log, flight log, telemetry log."""
