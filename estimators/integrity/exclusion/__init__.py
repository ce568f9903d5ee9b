"""Who is wrong: receivers and ranges named by fixes held against ranges, without any estimate.

`baselines` holds ranges against fixes, and against each other; `slow_errors` learns what they are off by while nobody
is; `fault_odds` has the odds of a receiver or of ranges being off, `jumps` those of far jumps, `spoiled_ranges` those
of ranges that are swapped or without a line of sight; `naming` names and takes back.
"""
