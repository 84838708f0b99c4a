"""Studies: methods x mixtures x seeds, ending in one comparison."""
