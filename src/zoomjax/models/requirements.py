"""What each use of a model asks of it, and the one sentence that refuses a model without it.

A function that serves some models alone has an entry in `REQUIREMENTS` and calls `check`. All others serve
all models; docs/formulation.md has the table, which is made by trying.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from .distortion_model import AbstractRadial
from .zoom import AbstractFocusZoom


class Requirement(NamedTuple):
    """What is asked of a model.

    Attributes:
        met: whether a model, a lens or a part of one is so.
        words: what it has to be, after "needs".
        instead: what to do with another one, a sentence; or empty.
    """

    met: Callable[[Any], bool]
    words: str
    instead: str = ""


_NO_CENTRE = "Decentering (p1, p2) does nearly the same as another centre: fit one of them."

RADIAL = Requirement(lambda model: isinstance(model, AbstractRadial), "a radial distortion model")
FOCAL_ALONE = Requirement(
    lambda zoom: not isinstance(zoom, AbstractFocusZoom),
    "a zoom model of the focal length alone",
    "A lens at one focus is one: lens.at_focus(focus).",
)
STILL_CENTRE = Requirement(
    lambda shift: shift is None, "a lens whose centre of distortion is the same at all focal lengths"
)

REQUIREMENTS: dict[str, dict[str, Requirement]] = {
    "fit_centre": {
        "zoom": FOCAL_ALONE._replace(instead=""),
        "distortion_model": RADIAL._replace(instead=_NO_CENTRE),
    },
    "fit_motion": {"zoom": FOCAL_ALONE._replace(instead="Tracks have no focus.")},
    "fit_boards": {"zoom": FOCAL_ALONE._replace(instead="Photos of boards have no focus.")},
    "fit_motion with lines": {"distortion_model": RADIAL},
    "with_misfit": {"zoom": FOCAL_ALONE._replace(instead="")},
    "suggest_next": {"zoom": FOCAL_ALONE._replace(instead=""), "shift": STILL_CENTRE},
    "cramer_rao": {"zoom": FOCAL_ALONE},
    "board_photo": {"zoom": FOCAL_ALONE, "distortion_model": RADIAL},
    "interop.write": {"zoom": FOCAL_ALONE},
}
"""By the use and by what is asked: the zoom model, the distortion model, or the shift of the centre."""


def refusal(use: str, **parts: Any) -> str:
    """Why a use does not serve a model with these parts; empty if it does."""
    for name, part in parts.items():
        required = REQUIREMENTS[use][name]
        if not required.met(part):
            given = "a centre that moves along the zoom" if name == "shift" else f"a {type(part).__name__}"
            return f"{use} needs {required.words}, and it was given {given}. {required.instead}".strip()
    return ""


def check(use: str, **parts: Any) -> None:
    """Raise ValueError where a use does not serve a model with these parts."""
    if reason := refusal(use, **parts):
        raise ValueError(reason)
