"""From a panel to batches: quotas, priorities, chunks."""
