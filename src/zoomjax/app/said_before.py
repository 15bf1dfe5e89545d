"""What earlier results say against their lines, and another fit to these cannot see.

That photos are of several lenses, that their distortion was corrected before, or that a clip does not tell
its focal lengths, is known where those are read. Their lines look like any others: a fit to them alone
would be called good.
"""

import contextlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .._core.text import listed, plain
from ..models.lens import ZoomLens, load_lens
from ..trust.assessment import VERDICTS, Finding
from .earlier import is_of_results
from .equipment import OTHER_CROP

_OF_THE_FIT = ("points outside", "focal lengths of single photos", "lens")
"""What findings are about that another fit has by itself, or that only follow from others."""

_SAME_ZOOM = 1.02
"""Ratio of digital zooms up to which they are one."""

_MOST = 4
_AGAIN = " Another fit to the same lines does not change that."


def findings_before(files: Sequence[Path], *, given_sigma: bool) -> list[Finding]:
    """What the summaries beside files of lines say against photos, clips and focal lengths.

    Args:
        files: of lines.
        given_sigma: whether standard deviations of focal lengths are given anew: then what was found of
            the last ones does not count.
    """
    found = [one for file in filter(is_of_results, files) for one in _of_file(file)]
    left = [one for one in found if not (given_sigma and one.about == "focal lengths")]
    return list(dict.fromkeys(left))


def findings_of_lenses(files: Sequence[Path]) -> list[Finding]:
    """That files of lines are of photos by different lenses or cameras, or of other parts of the sensor."""
    lenses: list[tuple[Path, ZoomLens]] = []
    for file in filter(is_of_results, files):
        with contextlib.suppress(OSError, ValueError):
            lenses.append((file, load_lens(file.with_name("lens.json"))))
    found = []
    for what in ("lens", "camera"):
        named = [(file, name) for file, one in lenses if isinstance(name := one.about.get(what), str)]
        if len(set(dict(named).values())) > 1:
            found.append(_different(f"different {'lenses' if what == 'lens' else 'cameras'}", named, str))
    for what, usual, most in (("crop_factor", None, OTHER_CROP), ("digital_zoom", 1.0, _SAME_ZOOM)):
        told = [(file, value) for file, one in lenses if (value := _number(one.about.get(what, usual)))]
        values = [value for _, value in told]
        if values and max(values) > most * min(values):
            found.append(_different(f"different {what.replace('_', ' ')}s", told, "{:.3g}".format))
    return found


def _different(what: str, of: Sequence[tuple[Path, Any]], text: Callable[[Any], str]) -> Finding:
    told = listed((f"{plain(text(value))} ({plain(str(file.parent))})" for file, value in of), _MOST)
    return Finding(
        what,
        "doubtful",
        f"the lines are of photos with {what}, by the lens.json beside them: {told}.",
        "Calibrate the lines of each by themselves.",
        cause=True,
    )


def _number(value: Any) -> float | None:
    number = isinstance(value, int | float) and not isinstance(value, bool) and value > 0
    return float(value) if number else None


def _of_file(file: Path) -> list[Finding]:
    """What a summary says that counts for the lines; nothing where it is damaged: `Earlier` tells that."""
    with contextlib.suppress(AttributeError, KeyError, OSError, TypeError, ValueError):
        summary = json.loads(file.with_name("summary.json").read_text())
        found = [Finding(**one) for one in summary["findings"]]
        return [
            Finding(one.about, one.verdict, one.found, one.advice.removesuffix(_AGAIN) + _AGAIN, cause=True)
            for one in found
            if one.verdict in VERDICTS[1:] and _stays(one, summary)
        ]
    return []


def _stays(one: Finding, summary: dict[str, Any]) -> bool:
    """Whether a finding is about what was read, and not about the fit."""
    if one.about in _OF_THE_FIT:
        return False
    if "clip" in summary:  # where they are relative, lens.json says so
        return one.about != "turning" or summary["focal_scale"] != "relative"
    # What was known of the focal lengths before the last fit to lines was kept.
    return one.cause and (one.about != "focal lengths" or "earlier" not in summary)
