"""What a learner is to be fed, as a file."""
