"""Pages about methods beside each other: a comparison, and a study of several arms."""
