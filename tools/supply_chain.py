"""Check that what is installed is what is locked: ``python tools/supply_chain.py``.

``requirements.lock`` has each distribution of ``constraints.txt`` in the same version, with the sha256 of its files,
and this environment holds nothing else and no other version. Versions are compared without the name of the build:
PyTorch's ``+cpu``. Its hash is that of the wheel that the committed results were made with.

Exit code 0: all of that holds; 1: something does not; 2: it could not be found out.
"""

import re
import sys
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
LOCK = ROOT / "requirements.lock"
CONSTRAINTS = ROOT / "constraints.txt"
OURS = {"marl-encircle", "pip"}
"""Not locked: this project, and what installs it."""

HASH = re.compile(r"--hash=sha256:[0-9a-f]{64}")


class CheckError(Exception):
    """The check could not do its work."""


class Pin(NamedTuple):
    """One line of the lock.

    :param hashes: how many files of that version are known
    """

    version: str
    hashes: int


def main() -> int:
    """Print what is wrong and return the exit code."""
    try:
        lock, constraints, installed = read_pins(LOCK), read_pins(CONSTRAINTS), installed_versions()
    except (CheckError, OSError, UnicodeDecodeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    faults = [*faults_of_lock(lock, constraints), *faults_of_environment(lock, installed)]
    for fault in faults:
        print(f"error: {fault}", file=sys.stderr)
    hashes = sum(pin.hashes for pin in lock.values())
    print(f"{len(lock)} distributions locked with {hashes} hashes, {len(installed)} installed, {len(faults)} faults")
    return 1 if faults else 0


def read_pins(path: Path) -> dict[str, Pin]:
    """Return the pins of a requirements file by name.

    :raises CheckError: for a line that is no pin, a name that comes twice, or no pin at all
    """
    pins: dict[str, Pin] = {}
    for line in path.read_text(encoding="utf-8").replace("\\\n", " ").splitlines():
        text = line.partition("#")[0].strip()
        if not text:
            continue
        try:
            requirement = Requirement(HASH.sub("", text).strip())
        except InvalidRequirement as error:
            raise CheckError(f"{path.name}: cannot be read: {text!r:.80}") from error
        specifiers = list(requirement.specifier)
        if len(specifiers) != 1 or specifiers[0].operator != "==":
            raise CheckError(f"{path.name}: {requirement.name} has no single version: {requirement.specifier}")
        name = canonicalize_name(requirement.name)
        if name in pins:
            raise CheckError(f"{path.name}: {name} stands there twice")
        pins[name] = Pin(specifiers[0].version.partition("+")[0], len(HASH.findall(text)))
    if not pins:
        raise CheckError(f"{path.name}: nothing is pinned there")
    return pins


def installed_versions() -> dict[str, str]:
    """Return the version of each installed distribution.

    :raises CheckError: if the package itself is not among them, one has no name, or one is there in two versions
    """
    versions: dict[str, str] = {}
    for distribution in metadata.distributions():
        if not distribution.metadata["Name"]:
            raise CheckError(f"a distribution without a name lies in {distribution.locate_file('')}")
        name, version = canonicalize_name(distribution.metadata["Name"]), distribution.version.partition("+")[0]
        if versions.setdefault(name, version) != version:  # which of the two is imported, the search path decides
            raise CheckError(f"{name} is there twice: {versions[name]} and {version}")
    if not versions.keys() >= OURS:
        raise CheckError("this environment does not hold the package: make setup")
    return {name: version for name, version in versions.items() if name not in OURS}


def faults_of_lock(lock: dict[str, Pin], constraints: dict[str, Pin]) -> list[str]:
    """Return where the lock is not the constraints with hashes."""
    faults = [f"requirements.lock: {name} has no hash" for name, pin in lock.items() if not pin.hashes]
    for name in sorted(lock.keys() | constraints.keys()):
        here, there = (pins[name].version if name in pins else "missing" for pins in (lock, constraints))
        if here != there:
            faults.append(f"requirements.lock: {name} is {here}, but {there} in constraints.txt; run make lock")
    return faults


def faults_of_environment(lock: dict[str, Pin], installed: dict[str, str]) -> list[str]:
    """Return what is installed but not as it is locked."""
    return [
        f"environment: {name} is {version}, but {lock[name].version if name in lock else 'missing'} in the lock"
        for name, version in sorted(installed.items())
        if name not in lock or lock[name].version != version
    ]


if __name__ == "__main__":
    sys.exit(main())
