"""Sample batches: quotas per stratum, rules within a stratum, and the ring of fresh rows."""
