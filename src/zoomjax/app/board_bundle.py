"""The bundle adjustment of photos of a board: their focal lengths, how bent it is, and the lens beside.

Made for grids of one size, where there are enough of them. Each zoom has a board's shape of its own where
it has photos enough: paper bends from day to day, and photos of a zoom are mostly taken in one go.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..detect.batch import Detection
from ..fit.boards import BoardFit, fit_boards
from ..fit.result import RESULTS, failed
from ..fit.zoom import CentreArgument
from ..models.lens import ZoomLens
from .focal_sources import Focals
from .plane_focals import FocalGroup

_CORNERS = 12
"""Corners of a photo that `fit_boards` asks for."""

_A_ZOOM, _IN_ALL = 4, 12
"""Photos from which a board's shape can be told from the lens: of each zoom, or of all together."""

_OWN_SHAPE = 8
"""Photos of each zoom from which each has a shape of its own."""

_UNCERTAIN = 0.1
"""Relative standard deviation of a focal length from which it replaces none."""


@dataclasses.dataclass(frozen=True)
class BoardBundle:
    """A bundle adjustment of photos of a board.

    Attributes:
        fit: the lens, focal lengths, poses and shapes.
        names: the photos in it.
        number: of each, the number of its zoom.
        unit: of the labels of the zooms.
    """

    fit: BoardFit
    names: tuple[str, ...]
    number: np.ndarray
    unit: str

    def measured(self, focals: Focals) -> Focals:
        """Focal lengths with those of the bundle adjustment in the place of a plane's homographies."""
        focal, std = np.asarray(self.fit.focal), np.asarray(self.fit.focal_std)
        good = np.isfinite(std) & (std < _UNCERTAIN * focal)
        new, deviation, groups = dict(focals.focal), dict(focals.deviation), []
        alone = [FocalGroup((name,), 0.0, 0.0) for name in focals.focal]
        for group in focals.groups or alone:
            numbers = {int(self.number[self.names.index(n)]) for n in group.names if n in self.names}
            zoom = next(iter(numbers)) if len(numbers) == 1 else -1
            if zoom >= 0 and good[zoom]:
                f, s = float(focal[zoom]), float(std[zoom])
                s = s if group.agree else max(s, group.std)  # they may be of two zooms
                new |= {name: f for name in group.names if name in new}
                deviation |= {name: s for name in group.names if name in new}
                group = dataclasses.replace(group, focal=f, std=s)
            if focals.groups:
                groups.append(group)
        origin = "bundle adjustment of the grid, which may be bent"
        return dataclasses.replace(
            focals, focal=new, deviation=deviation, groups=tuple(groups), origin=origin
        )

    def sentences(self) -> list[str]:
        """How bent the board is, and how well the model fits, in sentences."""
        bend, fit = self.fit.bend, self.fit
        rows, columns = fit.shape.shape[1:3]
        share = 100 * bend / max(rows - 1, columns - 1)
        how = (
            f"{bend[0]:.2f} steps of the grid"
            if len(bend) == 1
            else f"{bend.min():.2f} to {bend.max():.2f} steps of the grid, by zoom"
        )
        return [
            f"The board of {columns} × {rows} corners reaches {how} out of its plane, "
            f"{share.max():.2g} % of its length: bundle adjustment of {len(self.names)} photos, which "
            f"leaves {float(fit.fit.rms):.2g} px in the image."
        ]

    def compared(self, lens: ZoomLens, label: Sequence[float]) -> list[tuple[str, ...]]:
        """For each zoom how far both lenses move the image's corner outwards, px, and their difference."""
        corner, rows = np.zeros(2), []
        centre = (np.array(lens.image_size) - 1) / 2
        outward = (corner - centre) / np.linalg.norm(corner - centre)
        for own, focal, std in zip(label, self.fit.focal, self.fit.focal_std, strict=True):
            both = [
                float((np.asarray(one(float(f)).undistort(jnp.asarray(corner))) - corner) @ outward)
                for one, f in ((lens, own), (self.fit.lens, focal))
            ]
            rows.append(
                (
                    f"{own:.4g}",
                    f"{float(focal):.0f} ± {float(std):.0f}",
                    *(f"{value:+.2f}" for value in both),
                    f"{both[1] - both[0]:+.2f}",
                )
            )
        return rows

    def about(self) -> dict[str, Any]:
        """The entry of summary.json."""
        fit = self.fit
        return {
            "photos": len(self.names),
            "rms": float(fit.fit.rms),
            "noise": float(fit.noise),
            "focal_px": np.asarray(fit.focal).tolist(),
            "focal_px_std": [s if np.isfinite(s) else None for s in np.asarray(fit.focal_std).tolist()],
            "centre": np.asarray(fit.lens.centre).tolist(),
            "bend_steps": fit.bend.tolist(),
            "result": RESULTS[fit.fit.result],
        }


def bundle_of(
    used: Sequence[Detection], focals: Focals, centre: CentreArgument = "fit"
) -> BoardBundle | None:
    """The bundle adjustment of the photos' grids; None if there are too few of them, or it fails."""
    grids = {d.name: d.nodes for d in used if d.nodes is not None}
    grids = {name: of for name, of in grids.items() if np.isfinite(of[..., 0]).sum() >= _CORNERS}
    if not grids or not focals.known:
        return None
    shape, _ = Counter(of.shape for of in grids.values()).most_common(1)[0]
    grids = {name: of for name, of in grids.items() if of.shape == shape}
    label = np.array([focals.focal[name] for name in grids])
    values, number, counts = np.unique(label, return_inverse=True, return_counts=True)
    enough = counts.min() >= _A_ZOOM or (len(grids) >= _IN_ALL and len(grids) >= 2 * len(values))
    if not enough:
        return None
    board = number if counts.min() >= _OWN_SHAPE else None
    fit = fit_boards(list(grids.values()), label, image_size=used[0].image_size, board=board, throw=False)
    if bool(failed(fit.fit.result)) or not np.isfinite(float(fit.fit.rms)):
        return None
    return BoardBundle(fit, tuple(grids), number, focals.unit)
