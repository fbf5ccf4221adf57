"""Imported by every Python that starts with this folder on PYTHONPATH: notes what asks for the network, hides packages.

``SOAK_SOCKETS`` is a file that gets a line for whatever is done with a socket, ``SOAK_HIDDEN`` names packages that are
as good as not installed.
"""

import os
import sys
from pathlib import Path
from typing import Any


def _note(event: str, arguments: tuple[Any, ...]) -> None:
    if event.startswith("socket.") and event != "socket.gethostname":
        with Path(os.environ["SOAK_SOCKETS"]).open("a", encoding="utf-8") as file:
            file.write(f"{event} {arguments[1:]}\n")


if "SOAK_SOCKETS" in os.environ:
    sys.addaudithook(_note)
sys.modules.update(dict.fromkeys(os.environ.get("SOAK_HIDDEN", "").split()))  # type: ignore[arg-type]  # None: not there
