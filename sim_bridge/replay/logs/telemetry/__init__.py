"""Telemetry logs of ground stations (``.tlog``)."""
