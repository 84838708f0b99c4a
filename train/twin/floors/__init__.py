"""Where a robot drives: generated floors, floors from files and maps, and plans on them."""
