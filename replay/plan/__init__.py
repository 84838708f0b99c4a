"""Plan a panel from a mixture and a store: which rows, in which stratum, with which weight."""
