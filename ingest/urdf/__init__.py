"""What a robot's description (URDF) says of it: links, joints, shapes; drive, wheels, mass."""
