"""Figures 1 and 3 to 6, from geometry, learning curves, evaluation rounds and replays."""
