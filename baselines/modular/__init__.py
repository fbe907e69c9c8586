"""Modular policies: one action for each segment of the robot, by a graph network or a Transformer."""
