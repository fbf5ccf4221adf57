"""Build hook: wheel and sdist get record, policy and card of the first training seed of each cell in ``results/runs``.

``marl_encircle.experiments.pretrained`` finds them by name. An editable installation reads ``results/runs`` itself.
"""

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FILES = ("run.json", "policy.safetensors", "README.md")
TARGET = Path("marl_encircle", "pretrained")


class PretrainedHook(BuildHookInterface):
    """Put the policies into what is built; an sdist has them already when a wheel is built from it."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files to what the build includes."""
        if version == "editable":
            return
        runs = Path(self.root, "results", "runs")
        for cell in sorted(runs.glob("[!.]*/[!.]*")):
            folders = {path.parent.name.removeprefix("seed"): path.parent for path in cell.glob("seed*/run.json")}
            seeds = [seed for seed in folders if seed.isdigit()]
            if seeds:
                first = folders[min(seeds, key=int)]
                for path in filter(Path.exists, (first / name for name in FILES)):
                    build_data["force_include"][str(path)] = (TARGET / path.relative_to(runs)).as_posix()
