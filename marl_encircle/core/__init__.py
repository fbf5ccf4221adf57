"""The world in numbers: geometry, dynamics, scenes, observations and rewards on batches of worlds."""
