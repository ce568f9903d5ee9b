"""All limits of the monitors in one place, each with its reason.

Lengths in m, times in s or ticks of the fleet, sigmas are 1-sigma, nats are differences of log likelihoods.
"""

# --- what was measured last ---------------------------------------------------------------------------------

GPS_LOST_S = 1.5
"""Without a fix for so long a drone has to do without GPS: receivers give one a second or more, and may be late."""
GPS_LOST_FIXES = 4.0
"""Where fixes come faster, so many of them that do not come are enough."""
GPS_LOST_LEAST_S = 0.7
"""But none is missed earlier: links are late by that much."""
MIN_IMU_COVERAGE = 0.9
"""Share of a tick that IMU samples vouch for; of the rest, a tick of 0.1 s at the usual rates loses one sample."""
FIX_MEMORY_TICKS = 30
"""Fixes older than this say nothing about where a drone begins: its velocity is a slope over their time."""
RANGE_MEMORY_TICKS = 5
"""Without a range younger than this there is nothing to hold a drone at the place where ranges found it."""
RANGED_TICKS = 10
"""A range older than this holds a drone no longer, nor does one to a drone that has been silent for longer. Not every
module ranges to all neighbours in every tick, so ranges count together over this time."""
BLIND_TICKS = 10
"""Ticks without a position fix after which an estimator takes a drone that had some to be without."""

# --- the estimate's own covariance --------------------------------------------------------------------------

ALIGNED_SIGMA_M = 2.0
"""A start is over when the own position is known so well: a good fix of its own would not tell more."""
DEGRADED_SIGMA_M = 5.0
"""Worse than what a receiver alone gives: the fleet does not help any more."""
FAULT_SIGMA_M = 50.0
"""Not to be used for anything."""
TARGET_UNSEEN_S = 5.0
"""A target that nobody has measured for so long is where it was predicted to be."""

# --- where ranges hold a drone ------------------------------------------------------------------------------

DIRECTIONS = 3
"""Neighbours, and directions to them, that hold a drone without GPS."""
HELD_SPREAD = 0.03
"""Smallest share of the squares of unit vectors along an axis for ranges to hold it: about 10 degrees off a plane.
Closer to it an error of the ranges moves the drone by more than six times its size."""
FLAT_SPREAD = 0.01
"""The same for ranges that a hypothesis has already used: about 6 degrees. Its expected error has been found large
then, and this only says whether the ranges are to blame; near a plane they are."""
HELD_SIGMA_M = 1.5
"""A drone less well known is not held by ranges: they would be linearised where it is not. A place found by ranges
is none beyond it either."""
TOLD_SIGMA_M = 3.0
"""A neighbour's pair locates a drone that it knows at least this well."""
LOCATED_FRACTION = 0.15
"""A neighbour is located where the sigma of its position is below this fraction of the range to it."""

# --- what the data say --------------------------------------------------------------------------------------

OBSERVABLE_SIGMA_M = 10.0
"""Position sigma of an agent, along its worst direction, up to which the data say where it is: a tenth of what stands
for knowing nothing."""

# --- other places that fit as well --------------------------------------------------------------------------

FLOOR_M = 0.15
"""Expected errors below this are not worth an alarm."""
UNDERSTATED = 4.0
"""Expected square error against the estimate's own variance from which on the estimate is not to be trusted: its
sigma is half of what it should be."""
OVERSTATED = 1.5
"""Expected square error against the estimate's own variance from which on it replaces it."""
WEAK_M = 0.3
"""Expected error from which on ranges that do not determine a position leave it not observable."""
SETTLED_TICKS = 40
"""Ticks that such an error has to stay small before one or two neighbours in motion are taken to have done so."""
CERTAIN = 0.999
"""Weight of a hypothesis that is the only one."""
DISAGREEMENT_SQUARE = 25.0
"""Squared Mahalanobis distance in position from which on the estimate is at another place: five sigma."""
DECISIVE_NATS = 12.0
"""Difference of the log likelihoods of two places that decides between them: odds of 160 000."""
CREDIT = 0.25
"""Share of a Gaussian's information that is believed of the side of a plane: ranges in a plane tell of what is across
it in the second order only, and a linearisation takes that for more."""
SURE_NATS = 9.0
"""Evidence from which on the mirror image, with a probability of 1e-4, is left out of the covariance."""
CERTAIN_NATS = 24.0
"""Evidence for the estimate that settles the matter until the fleet comes near a plane again."""
FEWEST_MIRRORED = 4
"""Fewer drones are in one plane, and are their own mirror image."""

# --- sensors that contradict all others ----------------------------------------------------------------------

CONTRADICTING_SQUARE = 3.0
"""Average normalised squared residual of a receiver's rows from which on they contradict the rest. Over 45 unit
normals, three seconds of fixes five times a second, it exceeds 1.8 once in a thousand; and what a receiver claims is
seldom right to a factor of 1.3."""
AGREEING_SQUARE = 1.5
"""The same from which down they agree again."""
IGNORED_SQUARE = 4.0
"""The same from which on they get no weight: later than they are told of, so that one outlier takes nothing away."""
FEWEST_WITNESSES = 3
"""Drones whose receivers do not contradict: of fewer nobody can tell which of them is wrong."""
SETTLED_S = 10.0
"""So long after its fixes have lost their weight a position is taken to have got over them: in a flight whose
receiver is dragged away by 0.5 m/s its error is within its covariance after eight."""

# --- what cannot be -------------------------------------------------------------------------------------------

FAR_M = 1000.0
"""A fix or range this far from the estimate is none: those of reflections are a tenth of it."""
FAR_MPS = 100.0
"""The same of a velocity or speed."""
FAR_SIGMAS = 6.0
"""On top of both, so many sigmas of the estimate: one that knows little refuses little."""
IMPOSSIBLE_MPS2 = 500.0
"""No accelerometer of a drone says more: the widest measure 16 to 30 g."""
REFUSED_TOLD_S = 1.0
"""So long after the last one it is told."""
REFUSED_FOR_S = 3.0
"""Fixes refused one and all for so long: where nothing else holds the drone, the estimate is what is wrong."""
FAULTS_IN_A_ROW = 3
"""Estimates of ticks on end that fail, after which it is no use to go on from the last good one."""
BEGUN_ANEW_TOLD_S = 10.0
"""So long after a start from nothing it is told."""

# --- latency ------------------------------------------------------------------------------------------------

LATENCY_SHARE = 1.0
"""Error along the track by the latency's sigma, against the sigma of the fix itself, from which on it is what limits
the fix."""

# --- receivers that are off ---------------------------------------------------------------------------------

NAMED_NATS = 13.2
"""Odds from which on something is off. Three sorts of faults may begin in each half second of each receiver: of so
many in 24 drone hours, exp(13.2), at most one exceeds it by chance (Ville), as long as errors are as supposed."""
LEADING_NATS = 6.0
"""Lead over everything else that may be off, lest the wrong one be named: odds of 400."""
RANGES_AGE_S = 1.5
"""Ranges are named no earlier: a receiver that begins to be off shows in the ranges to the nearest drones first."""
SCATTERED = 6.0
"""Scatter of a pair's ranges, over what they claim, from which on they are off: half of sixteen have to be off by
more than four sigma at once, so neither noise nor a few blocked ones do it; a claim is wrong by two or three."""
AGREEING_SCATTER = 3.0
SCATTERED_S = 1.5
"""So long it takes to be seen."""
AGREEING_NATS = 3.0
AGREEING_S = 10.0
"""A receiver that is named counts again after odds below `AGREEING_NATS` for so long."""
FEWEST_RECEIVERS = 4
"""Of fewer nobody can tell which is off."""
