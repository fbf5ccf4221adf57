"""Search files of tiny trainings."""

from pathlib import Path

from tiny_runs import TINY

LEARNING_RATE = "{learning_rate: {low: 1e-4, high: 1e-2, log: true}}"


def search_file(folder: Path, **changes: str) -> Path:
    """A valid file with some lines changed or added."""
    lines = {
        "profile": "smoke",
        "setting": "{speed_ratio: 1.1, pursuers: 3, obstacles: 1}",
        "overrides": "[" + ", ".join(f'"{text}"' for text in TINY) + "]",
        "seeds": "[950]",
        "last_points": "2",
        "search": f"{{algorithm: {LEARNING_RATE}}}",
        **changes,
    }
    path = folder / "search.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in lines.items()))
    return path
