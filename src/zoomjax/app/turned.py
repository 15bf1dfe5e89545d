"""Photos that a program has turned by half a turn, so that no tag says it: the centre of distortion tells.

Turned about the middle of the image, the centre lies on its other side. The fitted one then lies between,
and lines of the turned photos are straighter about its mirror image.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._core.text import listed, plain
from ..fit.straightness import frame_rms
from ..lines.lines import Lines
from ..models.lens import ZoomLens
from ..trust.assessment import Finding

_STRAIGHTER = 0.9
"""RMS about the mirrored centre over that about the fitted one, from which it is more than chance."""

_LEAST = 0.005
"""Half diagonals that a centre is off the middle: nearer ones do no harm."""

_MOST = 4


def findings_of_turned(lines: Lines, lens: ZoomLens, names: Sequence[str]) -> list[Finding]:
    """That lines of some photos are clearly straighter where these are turned by half a turn.

    Args:
        lines: of all photos, without those that were rejected.
        lens: fitted to them.
        names: of the photos, one for each frame of the lines.
    """
    middle = (np.array(lens.image_size) - 1) / 2
    off = np.asarray(lens.centre, float) - middle
    if lens.shift is not None or np.hypot(*off) < _LEAST * float(lens.scale):
        return []
    mirrored = eqx.tree_at(lambda one: one.centre, lens, jnp.asarray(middle - off, lens.centre.dtype))
    here, there = (np.asarray(frame_rms(lines, one)) for one in (lens, mirrored))
    turned = np.flatnonzero(there < _STRAIGHTER * here)
    if not turned.size:
        return []
    worst = int(turned[np.argmin(there[turned] / here[turned])])
    told = listed((plain(names[frame]) for frame in turned.tolist()), _MOST)
    return [
        Finding(
            "turned photos",
            "doubtful",
            f"lines of {turned.size} of {len(names)} photos are straighter as if these were turned by half "
            f"a turn, {there[worst]:.2g} px off in place of {here[worst]:.2g} px in {plain(names[worst])}: "
            f"{told}.",
            "Use the photos as the camera stored them: a program has turned these, or the others.",
            cause=True,
        )
    ]
