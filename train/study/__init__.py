"""Studies: methods x mixtures x seeds, compared at the end."""
