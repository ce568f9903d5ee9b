"""UWB modules that are simulated down to their bytes, on pseudo terminals: what drivers of modules are tried on."""
