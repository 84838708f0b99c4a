"""Plans: from a mixture and a store to the rows of a panel, each in a stratum, with a weight."""
