"""From a sampled row back to the messages it was made from."""
