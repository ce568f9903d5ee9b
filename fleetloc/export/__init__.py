"""What was estimated and measured, for other tools: MCAP and its layout for plots, KML and GeoJSON for maps."""
