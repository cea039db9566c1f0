"""The robot, its worlds and their physics."""
