"""The simulated world: vehicles, sensors, truth, and the process that serves them."""
