"""Warnings that are raised on the way, for the results."""

import contextlib
import re
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

from .._core.text import plain
from ..fit.compiled import UNKEPT
from ._flags import with_flags


@contextlib.contextmanager
def heard() -> Iterator[list[str]]:
    """Yield a list that gets each warning for the user that is raised in the block, in words of the command
    line. All are shown as without it, but none twice."""
    found: list[str] = []
    with warnings.catch_warnings():
        show = warnings.showwarning

        def hear(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            told = plain(with_flags(str(message)))
            if told in found:
                return
            if issubclass(category, UserWarning) and not UNKEPT.match(str(message)):
                found.append(told)
            show(message, category, *where, **more)

        warnings.showwarning = hear
        yield found


def passed_on(caught: Sequence[warnings.WarningMessage], *, but: str) -> list[str]:
    """Raise warnings again that were caught, but those that a pattern fits, which are returned."""
    kept = [str(one.message) for one in caught if re.match(but, str(one.message))]
    for one in caught:
        if str(one.message) not in kept:
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return kept
