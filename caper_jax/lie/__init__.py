"""Lie groups SO(3) and SE(3) in closed form."""
