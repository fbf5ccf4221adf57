"""Encircling a faster target with multi-agent reinforcement learning."""
