"""A really lossy radio on one machine: network namespaces on a segment whose frames are lost and late."""
