"""Names that the shell completes; where it finds none it goes on with files, since most options take paths too."""

from collections.abc import Callable

from marl_encircle.experiments.library import Kind, files_of


def names_of(*kinds: Kind) -> Callable[[], list[str]]:
    """Return what tells the names of files of these kinds; typer leaves out those that do not fit."""
    return lambda: [name for kind in kinds for name in files_of(kind)]


def scenes() -> list[str]:
    """Return the names of the scenes."""
    from marl_encircle.core.scenes import SCENES

    return list(SCENES)
