"""The parts that all pages share: blocks, charts in light and dark, and the template."""
