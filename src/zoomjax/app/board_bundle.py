"""The bundle adjustment of photos of a board: their focal lengths, and how bent it is.

Made for grids of one size, where there are enough of them. Each zoom has a board's shape of its own where
it has photos enough: paper bends from day to day, and photos of a zoom are mostly taken in one go.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..detect.batch import Detection
from ..fit.boards import BoardFit, fit_boards
from ..fit.result import RESULTS, ZoomFit, failed
from ..fit.zoom import CentreArgument
from ..models.lens import ZoomLens
from .board_lines import Straightness, flat_detections, straightness, widened
from .focal_sources import Focals, lines_of
from .plane_focals import FocalGroup

_CORNERS = 12
"""Corners of a photo that `fit_boards` asks for."""

_A_ZOOM, _IN_ALL = 4, 12
"""Photos from which a board's shape can be told from the lens: of each zoom, or of all together."""

_OWN_SHAPE = 8
"""Photos of each zoom from which each has a shape of its own."""

_BENDS = 0.005
"""Steps of the grid that a board bends from photo to photo from which on it is said."""

_EXPLAINED = 3.0
"""Residuals of a photo, in the median of all, up to which the bundle adjustment explains it."""

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
        flat: the photos in it with the lines of a flat board.
        straightness: of these lines and of those that are seen; None if no lens fits them.
    """

    fit: BoardFit
    names: tuple[str, ...]
    number: np.ndarray
    unit: str
    flat: tuple[Detection, ...]
    straightness: Straightness | None

    @property
    def bent(self) -> bool:
        """Whether the lens is fitted to lines of a flat board: see `Straightness.bent`."""
        return self.straightness is not None and self.straightness.bent

    @property
    def bend_between_photos(self) -> float:
        """How far corners are out of the board's shape in single photos, RMS, steps of the grid."""
        return float(np.sqrt(np.mean(np.square(self.fit.poses.bend))))

    def lines_used(self, detections: Sequence[Detection]) -> list[Detection]:
        """The detections with the lines that the lens is fitted to."""
        flat = {d.name: d for d in self.flat} if self.bent else {}
        return [flat.get(d.name, d) for d in detections]

    def widened(self, fit: ZoomFit) -> ZoomFit:
        """A fit to these lines with what is uncertain of the board's shape in its bands."""
        return widened(fit, self.fit) if self.bent else fit

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
                explained = group.agree or self._explains(group)
                s = s if explained else max(s, group.std)  # they may be of two zooms
                new |= {name: f for name in group.names if name in new}
                deviation |= {name: s for name in group.names if name in new}
                group = dataclasses.replace(group, focal=f, std=s, agree=explained)
            if focals.groups:
                groups.append(group)
        origin = "bundle adjustment of the grid, which may be bent"
        return dataclasses.replace(
            focals, focal=new, deviation=deviation, groups=tuple(groups), origin=origin
        )

    def _explains(self, group: FocalGroup) -> bool:
        """Whether it explains the photos of a group by one focal length, as well as all others."""
        rms = np.asarray(self.fit.fit.frame_rms)
        own = [rms[self.names.index(name)] for name in group.names if name in self.names]
        return bool(np.max(own) < _EXPLAINED * np.nanmedian(rms))  # NaN: most of its corners are outliers

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
            f"{share.max():.2g} % of its length{self._between()}: bundle adjustment of {len(self.names)} "
            f"photos, which leaves {float(fit.fit.rms):.2g} px in the image.",
            *self._told(),
        ]

    def _told(self) -> list[str]:
        """Which lines the lens is fitted to, and why."""
        of = self.straightness
        if of is None:
            return []
        seen, flat = f"{of.rms_seen:.2g} px", f"{of.rms_flat:.2g} px"
        if self.bent:
            return [
                "The lens is fitted to rows and columns as a flat board would show them: their median "
                f"deviation is {flat}, and {seen} as they are seen."
            ]
        return [
            "The lens is fitted to rows and columns as they are seen: their median deviation is "
            f"{seen}, and would hardly be less, {flat}, on a flat board."
        ]

    def _between(self) -> str:
        """How it bends from photo to photo, if more than can be told from nothing."""
        bend = self.bend_between_photos
        return f", and bends by {bend:.2g} steps from photo to photo" if bend > _BENDS else ""

    def compared(self, lens: ZoomLens, label: Sequence[float]) -> list[tuple[str, ...]]:
        """For each zoom how far lenses move the image's corner outwards, px.

        Those are the lens that makes rows and columns straight as they are seen, `lens`, and that of the
        bundle adjustment.
        """
        corner, rows = np.zeros(2), []
        centre = (np.array(lens.image_size) - 1) / 2
        outward = (corner - centre) / np.linalg.norm(corner - centre)
        seen = None if self.straightness is None else self.straightness.seen
        zooms = (self.fit.label.tolist(), label, self.fit.focal.tolist(), self.fit.focal_std.tolist())
        for first, own, focal, std in zip(*zooms, strict=True):
            moved = [
                (np.asarray(one(float(f)).undistort(corner)) - corner) @ outward if one else np.nan
                for one, f in ((seen, first), (lens, own), (self.fit.lens, focal))
            ]
            rows.append(
                (
                    f"{own:.4g}",
                    f"{focal:.0f} ± {std:.0f}",
                    *(f"{value:+.2f}" if np.isfinite(value) else "" for value in moved),
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
            "bend_between_photos_steps": self.bend_between_photos,
            "flat_lines": self.bent,
            "lines_deviation": self.straightness and self.straightness.rms_seen,
            "lines_deviation_flat": self.straightness and self.straightness.rms_flat,
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
    of = [d for d in used if d.name in grids]
    flat = flat_detections(fit, of)
    seen, even = (lines_of(some, label, focals.unit) for some in (of, flat))
    straight = straightness(fit, seen, even, centre)
    return BoardBundle(fit, tuple(grids), number, focals.unit, tuple(flat), straight)
