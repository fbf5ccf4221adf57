"""Figures 1 and 3 to 6, from geometry, learning curves, evaluation rounds and replays; needs Matplotlib."""

try:
    import matplotlib  # noqa: F401
except ImportError as error:
    raise ImportError("figures need Matplotlib: pip install 'matplotlib>=3.9'") from error
