"""Docstrings refer to each other in Sphinx's way, :func:`name`; such a name becomes a link where it is on the site."""

import re
from typing import Any

from griffe import AliasResolutionError, Extension, NameResolutionError, Object

_ROLE = re.compile(r":(?:attr|class|data|func|meth|mod):`(~?)([\w.]+)`")


class Roles(Extension):
    """Turn roles into links."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Rewrite the docstring of everything that is documented."""
        if obj.docstring is not None:
            obj.docstring.value = _ROLE.sub(lambda match: _link(obj, match), obj.docstring.value)


def _link(obj: Object, match: re.Match[str]) -> str:
    short, name = match.groups()
    text = name.rpartition(".")[2] if short else name
    try:
        target = name if name.startswith("marl_encircle.") else obj.resolve(name)
    except (NameResolutionError, AliasResolutionError):
        return f"`{text}`"
    return f'<autoref optional identifier="{target}"><code>{text}</code></autoref>'
