"""Whether a position can be trusted: monitors of one shape, ``observe(evidence) -> findings``.

`finding` says what a finding and a monitor are, `thresholds` holds all limits. Of the own position: `solution`,
`staleness`, `range_geometry`, `range_location`, `latency_doubt`, and `ambiguity` over the mixture of `hypotheses`. Of
a whole window (`window_evidence`): `data_observability` and `fleet_mirror`. `observability` and `consistency` are
measures that these and the studies share.
"""
