"""ArduPilot dataflash logs (``.BIN``)."""
