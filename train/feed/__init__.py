"""What a batch is made of, and the record of it."""
