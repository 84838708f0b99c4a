"""What every page shares: its blocks, its charts in light and dark, and the one template."""
