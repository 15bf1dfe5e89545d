"""How surely the line points of the facade tell its lens: can two lenses of them differ by 3 % by chance?

The fit to the points that the authors' program found in the facade (primitives.txt) has bands, clustered by
line, and is repeated on lines drawn with replacement. Beside these are the lens of everything automatic,
what the authors' program made of its own points, and half of their points against the other half.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

import zoomjax as zj
from zoomjax.detect.batch import detect
from zoomjax.detect.edges import EdgeDetector
from zoomjax.detect.sources import find_photos

from .shared import table
from .wide_facade import RADII, as_lines, displacements, fitted, primitives

DRAWS = 400
"""Times that lines are drawn with replacement."""

ONE = zj.PolynomialZoom(degree=0)


def bands(folder: Path) -> dict[str, Any]:
    """Displacements at the radii by their points, their standard deviations, and those of other lenses."""
    path = folder / "building.png"
    image = cv2.imread(str(path))
    assert image is not None
    size = (image.shape[1], image.shape[0])
    theirs = as_lines(primitives(folder / "primitives.txt", size[1]), size)
    robust = fitted(primitives(folder / "primitives.txt", size[1]), size)
    own = fitted(next(detect(find_photos([path]), EdgeDetector())).lines, size)
    kept = np.asarray(robust.weight) > 0
    small = zj.compress(theirs)
    alike = zj.fit_zoom(small.weighted(kept.astype(float)), zoom=ONE)
    towards = -np.array(size) / np.hypot(*size)
    points = (np.array(size) - 1) / 2 + RADII[:, None] * np.hypot(*size) / 2 * towards
    rng, chosen, drawn, parted = np.random.default_rng(0), np.flatnonzero(kept), [], []
    for _ in range(DRAWS):
        counts = np.bincount(rng.choice(chosen, len(chosen)), minlength=len(kept))
        drawn.append(_displacements(small, counts, size))
    for _ in range(DRAWS // 2):
        first = np.zeros(len(kept))
        first[rng.permutation(chosen)[: len(chosen) // 2]] = 1
        parted.append(_displacements(small, first, size) - _displacements(small, kept - first, size))
    return {
        "lines": int(kept.sum()),
        "displacement_px": displacements(robust.fit.lens(1.0), size).tolist(),
        "automatic_px": displacements(own.fit.lens(1.0), size).tolist(),
        "bands_px": np.asarray(zj.displacement_std(robust.fit, points, focal=1.0)).tolist(),
        "bands_automatic_px": np.asarray(zj.displacement_std(own.fit, points, focal=1.0)).tolist(),
        "alike_px": displacements(alike.lens(1.0), size).tolist(),
        "drawn_px": np.std(drawn, axis=0).tolist(),
        "halves_px": np.sqrt(np.mean(np.square(parted), axis=0)).tolist(),
    }


def _displacements(small: Any, weight: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """At the radii, of the fit to lines of these weights."""
    fit = zj.fit_zoom(small.weighted(weight.astype(float)), zoom=ONE, throw=False)
    return displacements(fit.lens(1.0), size)


def bands_page(told: dict[str, Any], house: dict[str, Any] | None) -> list[str]:
    """The same in per cent of the displacement, with what is beyond chance."""
    moved = np.array(told["displacement_px"])

    def share(values: Any) -> list[str]:
        return [f"{100 * value:.1f}" for value in np.asarray(values) / moved]

    apart = np.array(told["automatic_px"]) - moved
    spread = np.hypot(told["bands_px"], told["bands_automatic_px"])
    rows = [
        ["standard deviation by bands, their points", *share(told["bands_px"])],
        ["the same, automatic", *share(told["bands_automatic_px"])],
        ["their lines drawn with replacement", *share(told["drawn_px"])],
        ["half of their lines against the other half, RMS", *share(told["halves_px"])],
        ["automatic less their points", *share(apart)],
        ["the same, in standard deviations of both", *(f"{value:+.1f}" for value in apart / spread)],
    ]
    program = (house or {}).get("program", {}).get("pol")
    if program:
        rows.append(
            ["their program less their points", *share(np.array(program["displacement_px"]) - moved)]
        )
    return [
        "## What the facade's lines can tell",
        "",
        f"The polynomial about the image's centre, fitted to those {told['lines']} of the authors' lines "
        "that are straight. Per cent of the displacement at shares of the way to the corner, but where it "
        f"is said. Lines are drawn {DRAWS} times; halves are parted {DRAWS // 2} times. Bands take lines "
        f"as independent. What is found automatically differs by {np.max(np.abs(apart / moved)):.1%} at "
        f"most, and by {np.max(np.abs(apart / spread)):.1f} standard deviations of both: lines of this "
        "photo do not tell more.",
        "",
        *table(["", *map(str, RADII)], rows),
    ]
