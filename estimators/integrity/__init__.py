"""Whether a position can be trusted: monitors of one shape, ``observe(evidence) -> findings``.

`finding` says what a finding and a monitor are, `thresholds` holds all limits. Of the own position: `solution`,
`staleness`, `range_geometry`, `range_location`, `latency_doubt`. Of the place of any drone without fixes: `ambiguity`
over the mixture of `hypotheses`, which holds both sides of a plane (`mirror_images`). Of a whole window
(`window_evidence`): `data_observability`, `fleet_mirror`; of rows that leave it: `innovations`. `observability` and
`consistency` are measures that these and the studies share.
"""
