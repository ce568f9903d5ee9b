"""Whether a position can be trusted: monitors of one shape, ``observe(evidence) -> findings``.

`finding` says what a finding and a monitor are, `thresholds` holds all limits. Of the own position: `solution`,
`staleness`, `range_geometry`, `range_location`, `latency_doubt`. Of a whole window (`window_evidence`):
`data_observability`; of rows that leave it: `innovations`. `places` asks where else a drone, or the fleet, may be;
`sets` holds where the neighbours certainly are, `exclusion` names receivers that are off, `protection` states how far
off a position can be.
`observability` and `consistency` are measures that these and the studies share.
"""
