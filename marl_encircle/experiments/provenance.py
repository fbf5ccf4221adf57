"""Where a number comes from: sources, commit, versions and processor."""

import hashlib
import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path

from marl_encircle.experiments.library import PACKAGE

PACKAGES = ("numpy", "numba", "torch", "stable-baselines3", "gymnasium", "pettingzoo", "supersuit")


def source_hash() -> str:
    """sha256 over the package's Python and YAML files, in hexadecimal."""
    digest = hashlib.sha256()
    for path in sorted([*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.yaml")]):
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def git_commit() -> str | None:
    """Return the commit of the checkout that the package runs from, ``-dirty`` if it has changes; else None."""
    if not (PACKAGE.parent / ".git").exists():  # else that of a repository around an installation
        return None
    command = ["git", "-C", str(PACKAGE), "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None


def versions() -> dict[str, str]:
    """Return the versions that results depend on."""
    return {"python": platform.python_version(), **{name: metadata.version(name) for name in PACKAGES}}


def cpu_model() -> str:
    """Return the processor's name."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or os.uname().machine
