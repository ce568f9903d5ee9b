"""Studies over tick-level recordings: scenario, links, the exchange, the genie, Monte Carlo."""
