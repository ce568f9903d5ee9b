"""The mathematics of fleetloc: models, windows, consensus, solvers, estimators.

Arrays in, arrays out. Nothing here reads a clock, a socket or a global random generator, and nothing here
imports another room of the project (docs/architecture.md).
"""
