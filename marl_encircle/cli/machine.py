"""This installation and this machine."""

import subprocess
import sys

import typer

from marl_encircle.experiments.library import PACKAGE
from marl_encircle.experiments.yaml_files import ConfigError


def bench() -> None:
    """Measure the speed rows and write benchmarks/results.json; needs a checkout."""
    script = PACKAGE.parent / "benchmarks" / "run.py"
    if not script.exists():
        raise ConfigError("bench needs a checkout of the repository; this installation has no benchmarks/run.py")
    raise typer.Exit(subprocess.run([sys.executable, str(script)], check=False).returncode)
