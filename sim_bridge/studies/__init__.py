"""Studies over tick-level recordings: scenario, passages of a plane, links, the exchange, the genie, Monte Carlo."""
