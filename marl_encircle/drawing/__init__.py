"""Drawings of a world: what they show as numbers, colours and outlines, and pygame-ce to draw them with."""
