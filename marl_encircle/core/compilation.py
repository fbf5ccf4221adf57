"""The one decorator that turns the core's plain Python into machine code, and where that code is kept.

Numba's own cache keys a kernel by its own file alone: a kernel whose *callee* changed in another file would run the old
machine code in the next process. The cache folder here carries a hash of every source file of ``core``, so any edit
starts a fresh one. Where no folder of the user's can be written, a private temporary one is used for this process.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba

P = ParamSpec("P")
R = TypeVar("R")


def core_hash() -> str:
    """Return the hash of the core's source files, 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Return a writable folder for compiled kernels.

    ``MARL_ENCIRCLE_CACHE``, else ``XDG_CACHE_HOME``, else ``~/.cache``; else a new temporary folder.
    """
    name = f"numba-{core_hash()}"
    for root in (os.environ.get("MARL_ENCIRCLE_CACHE"), os.environ.get("XDG_CACHE_HOME"), "~/.cache"):
        if not root:
            continue
        try:
            folder = Path(root).expanduser() / "marl_encircle" / name
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except (OSError, RuntimeError):  # not writable, or no home at all
            continue
    return Path(tempfile.mkdtemp(prefix="marl_encircle-"))


_CACHE_FOLDER = cache_folder()


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` on its first call and keep the machine code on disk.

    Division by zero gives inf or nan as in NumPy, and sums may be regrouped, so that loops over directions have no
    branches and vectorise; inf and nan keep their meaning. A world's numbers do not depend on the rest of its batch.
    """
    # Numba reads the folder at decoration only; other people's kernels in this process keep their own.
    config: Any = numba.config
    theirs = config.CACHE_DIR
    config.CACHE_DIR = str(_CACHE_FOLDER)
    try:
        compiled: Callable[P, R] = numba.njit(
            cache=True, error_model="numpy", nogil=True, forceinline=True, fastmath={"reassoc", "contract", "nsz"}
        )(function)
    finally:
        config.CACHE_DIR = theirs
    return compiled
