"""Who is wrong: receivers and ranges named by fixes held against ranges, without any estimate.

`baselines` holds ranges against fixes, `slow_errors` learns what they are off by while nobody is, `fault_odds` has
the odds of a receiver or of ranges being off, `naming` names and takes back.
"""
