"""Docstrings as griffe reads them: ``Example:`` is a heading, ``zoom, terms: as in ...`` documents both."""

import re
from typing import Any

import griffe

SEVERAL = re.compile(r"^    ((?:\w+, )+\w+): (.*(?:\n {5,}.*)*)", re.MULTILINE)


class OurDocstrings(griffe.Extension):
    """Rewrite docstrings before they are parsed."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for each module, class, function and attribute."""
        if obj.docstring:
            text = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
            obj.docstring.value = SEVERAL.sub(_each, text)


def _each(found: re.Match[str]) -> str:
    return "\n".join(f"    {name}: {found[2]}" for name in found[1].split(", "))
