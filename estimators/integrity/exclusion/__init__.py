"""Who is wrong: receivers named by fixes held against ranges, without any estimate.

`baselines` holds ranges against fixes, `receiver_faults` has the odds of one receiver being off, `naming` names it
and takes it back.
"""
