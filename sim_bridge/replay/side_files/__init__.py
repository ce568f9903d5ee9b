"""Files beside the logs: the ranges and the truth of a recorded flight, and what reads them."""
