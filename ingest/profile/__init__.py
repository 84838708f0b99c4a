"""How a robot's topics fill the signals."""
