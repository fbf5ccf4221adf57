"""Build hook: wheel and sdist get record, policy and card of the first training seed of each cell in ``results/runs``.

``marl_encircle.experiments.pretrained`` finds them by name. Of a first seed that diverged only the record goes along,
which the error names: another seed in its place would be a chosen one. An editable installation reads ``results/runs``
itself.
"""

import json
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
                record = json.loads((first / "run.json").read_bytes())
                names = FILES if record["status"] == "finished" else FILES[:1]
                for path in filter(Path.exists, (first / name for name in names)):
                    build_data["force_include"][str(path)] = (TARGET / path.relative_to(runs)).as_posix()
