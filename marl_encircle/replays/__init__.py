"""Rounds to look at: a round recorded step by step, played in a window, written as a film."""
