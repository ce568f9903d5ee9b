"""Where a drone certainly is: sets that hold it as long as the stated bounds of the sensors hold.

`ellipsoid` is the form of a set, `kernels` the compiled steps on it, `cuts` the same on values. `relative` is the
filter of one neighbour (`relative_kernels` its step), `bank` those of all, fed with the rows that estimators take.
"""
