"""List the licences of all that the package needs, from the metadata of what is installed.

``python tools/licences.py`` writes ``docs/licences.md``, in which what is not installed here keeps its line. Exit code
1, and nothing is written, if a licence is unknown or does not go together with this project's MIT licence; 2 if the
package itself is not installed.
"""

import re
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = "marl-encircle"
PAGE = Path(__file__).resolve().parents[1] / "docs" / "licences.md"
TOOLS = ("dev", "docs", "lock", "mutation")
"""Extras of developers: programs that are run, never a part of the package or of what it hands on."""

PERMISSIVE = {
    "0BSD", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0",
    "ISC", "MIT", "MIT-CMU", "PSF-2.0", "Unlicense", "Zlib",
}  # fmt: skip
UNCHANGED = {"LGPL-2.1", "MPL-2.0"}
"""Fit as long as their own files are used as they are."""

AS_TOOLS = {"GPL-2.0-only"}

SPELLINGS = {
    "3-clause bsd license": "BSD-3-Clause",
    "apache 2.0": "Apache-2.0",
    "apache license 2.0": "Apache-2.0",
    "apache software license": "Apache-2.0",
    "bsd 2-clause license": "BSD-2-Clause",
    "bsd 3-clause license": "BSD-3-Clause",
    "bsd license": "BSD",
    "gnu library or lesser general public license (lgpl)": "LGPL-2.1",
    "isc license": "ISC",
    "isc license (iscl)": "ISC",
    "lgpl v2.1": "LGPL-2.1",
    "mit license": "MIT",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
    "psfl": "PSF-2.0",
    "python software foundation license": "PSF-2.0",
}
"""What metadata say -> SPDX, where it is one; the classifier ``BSD License`` does not tell which."""

HEAD = """# Licences

What the package needs, by the metadata of the distributions, and whether it needs it always or for an extra. Written by
`make licences`; a test refuses what is unknown or does not go together with the MIT licence. {tools} are
programs for developers.

| distribution | licence | needed by |
| --- | --- | --- |
"""


def main() -> int:
    """Write the page and return the exit code."""
    try:
        needed = needed_by(PROJECT)
    except metadata.PackageNotFoundError:
        print(f"error: {PROJECT} is not installed in this environment: make setup", file=sys.stderr)
        return 2
    licences = {name: licence_of(metadata.distribution(name).metadata) for name in needed}
    faults = [fault for name, users in needed.items() if (fault := fault_of(name, licences[name], users))]
    for fault in faults:
        print(f"error: {fault}", file=sys.stderr)
    if faults:
        return 1
    rows = read_page() | {name: (licences[name], ", ".join(users)) for name, users in needed.items()}
    lines = [f"| {name} | {licence} | {users} |\n" for name, (licence, users) in sorted(rows.items())]
    PAGE.write_text(HEAD.format(tools=", ".join(f"`{extra}`" for extra in TOOLS)) + "".join(lines), encoding="utf-8")
    print(f"{PAGE}: {len(needed)} distributions installed, {len(rows)} listed")
    return 0


def read_page() -> dict[str, tuple[str, str]]:
    """Return licence and users of each distribution on the page."""
    rows = re.findall(r"^\| (\S+) \| (.+) \| (.+) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return {name: (licence, users) for name, licence, users in rows if name not in ("---", "distribution")}


def needed_by(project: str) -> dict[str, list[str]]:
    """Return the installed distributions that a project needs, with ``package`` or the extras that bring them.

    :raises PackageNotFoundError: if the project is not installed
    """
    extras = metadata.metadata(project).get_all("Provides-Extra", [])
    everything: dict[str, list[str]] = {}
    for user in ("", *sorted(extras)):
        for name in reached(project, user):
            if "package" not in everything.get(name, []):
                everything.setdefault(name, []).append(user or "package")
    return dict(sorted(everything.items()))


def reached(project: str, extra: str) -> set[str]:
    """Return the installed distributions that a project with an extra needs, directly or not."""
    found: set[str] = set()
    waiting = [(project, extra)]
    seen = set(waiting)
    while waiting:
        name, wanted = waiting.pop()
        for text in metadata.requires(name) or []:
            requirement = Requirement(text)
            if requirement.marker and not requirement.marker.evaluate({"extra": wanted}):
                continue
            other = canonicalize_name(requirement.name)
            if not is_installed(other):
                continue
            found.add(other)
            for step in ((other, inner) for inner in ("", *requirement.extras)):
                if step not in seen:
                    seen.add(step)
                    waiting.append(step)
    return found - {canonicalize_name(project)}


def is_installed(name: str) -> bool:
    """Whether there is such a distribution in this environment."""
    try:
        metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return False
    return True


def licence_of(about: metadata.PackageMetadata) -> str | None:
    """Return a distribution's licence as an SPDX expression where its metadata allow, None where they say nothing."""
    expression = about.get("License-Expression")
    if expression:
        return str(expression)
    texts = [(about.get("License") or "").strip()]
    texts += [text.rpartition(" :: ")[2] for text in about.get_all("Classifier", []) if text.startswith("License ::")]
    known = [SPELLINGS.get(text.lower(), text) for text in texts]
    return next((text for text in known if is_known(text)), None)


def is_known(expression: str) -> bool:
    """Whether every licence of an expression is one that was looked at."""
    return goes_with(expression, PERMISSIVE | UNCHANGED | AS_TOOLS)


def goes_with(expression: str, allowed: set[str]) -> bool:
    """Whether an expression without brackets can be met by allowed licences alone."""
    return any(all(part in allowed for part in option.split(" AND ")) for option in expression.split(" OR "))


def fault_of(name: str, licence: str | None, users: Iterable[str]) -> str | None:
    """Return what is wrong with a distribution's licence, None if nothing is."""
    if licence is None or not is_known(licence):
        return f"{name}: unknown licence: {licence}"
    tool = set(users) <= set(TOOLS)
    if not goes_with(licence, PERMISSIVE | UNCHANGED | (AS_TOOLS if tool else set())):
        return f"{name}: {licence} does not go together with the MIT licence; needed by {', '.join(users)}"
    return None


if __name__ == "__main__":
    sys.exit(main())
