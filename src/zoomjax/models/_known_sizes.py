"""For which size of images the distortion is that a lens returned, known beside it.

Not in a field: as a static one it would make the distortions of lenses other pytrees than those made by
hand, which then do not go together through ``lax.cond``, ``scan`` and ``tree.map``; and copies with another
centre, as for crops, would have it. So it is known of one object, as it is, and of no copy.
"""

import weakref
from typing import Any, TypeVar

Sized = TypeVar("Sized")

_KNOWN: dict[int, tuple[Any, tuple[int, int]]] = {}


def with_known_size(thing: Sized, image_size: tuple[int, int]) -> Sized:
    """The thing itself, of which `known_size` is (width, height) px from now on."""
    key = id(thing)
    _KNOWN[key] = weakref.ref(thing, lambda _: _KNOWN.pop(key, None)), image_size
    return thing


def known_size(thing: Any) -> tuple[int, int] | None:
    """(width, height) px, or None."""
    return _KNOWN.get(id(thing), (None, None))[1]
