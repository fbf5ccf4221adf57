"""Names that the shell completes; where it finds none it goes on with files, since most options take paths too."""

from collections.abc import Callable

from marl_encircle.experiments.library import Kind, files_of


def names_of(*kinds: Kind) -> Callable[[str], list[str]]:
    """Return what completes the names of files of these kinds."""

    def complete(incomplete: str) -> list[str]:
        return [name for kind in kinds for name in files_of(kind) if name.startswith(incomplete)]

    return complete


def scenes(incomplete: str) -> list[str]:
    """Return the scenes whose names begin so."""
    from marl_encircle.core.scenes import SCENES

    return [name for name in SCENES if name.startswith(incomplete)]
