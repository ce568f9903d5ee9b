"""Where else may a drone be: places that the measurements allow beside the estimate.

Of a drone without fixes: `ambiguity` over the mixture of `hypotheses`, which holds both sides of a plane
(`mirror_images`). Of the whole fleet: `fleet_mirror`.
"""
