"""The bundle adjustment of photos of a board: their focal lengths, and how bent it is.

Made for grids of one size, where there are enough of them. Each zoom has a board's shape of its own where
it has photos enough: paper bends from day to day, and photos of a zoom are mostly taken in one go.
"""

import dataclasses
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._core.text import plain
from ..detect.batch import Detection
from ..fit.boards import BoardFit, fit_boards
from ..fit.result import RESULTS, ZoomFit, failed
from ..fit.zoom import CentreArgument
from ..models.lens import ZoomLens
from .board_lines import Straightness, flat_detections, straightness, widened
from .focal_sources import GRID, Focals, lines_of
from .plane_focals import MOST_UNCERTAIN, FocalGroup, may_be_of_one_zoom

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

_MOST_NAMES = 8
"""Photos that a sentence names."""

_UNDETERMINED = (
    "The shape of the board was not fitted, and it counts as flat: beside its shape, the photos do not "
    "determine their focal lengths. Take more of them, oblique and from several sides."
)

_NO_MINIMUM = "The shape of the board was not fitted: the bundle adjustment found no minimum."

_NO_FOCAL = (
    "the bundle adjustment of all photos does not determine its focal length: the board is seen too "
    "squarely in it, or bends otherwise than in the others"
)


@dataclasses.dataclass(frozen=True)
class BoardBundle:
    """A bundle adjustment of photos of a board.

    Attributes:
        fit: the lens, focal lengths, poses and shapes.
        names: the photos in it.
        lost: those left out of it, as nothing determines their focal lengths.
        number: of each, the number of its zoom.
        unit: of the labels of the zooms.
        before: whose they are: "of homographies", for instance.
        flat: the photos in it with the lines of a flat board.
        straightness: of these lines and of those that are seen; None if no lens fits them.
    """

    fit: BoardFit
    names: tuple[str, ...]
    lost: tuple[str, ...]
    number: np.ndarray
    unit: str
    before: str
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
        """Focal lengths with those of the bundle adjustment in the place of a plane's homographies.

        Photos of a zoom whose focal length it does not determine have none: homographies tell one only
        by taking the board as flat. Photos of a zoom that it does not see keep theirs.
        """
        focal, deviation, groups = dict(focals.focal), dict(focals.deviation), []
        shared = {name for group in focals.groups for name in group.names}
        alone = [FocalGroup((name,), 0.0, 0.0) for name in focals.focal if name not in shared]
        for group in (*focals.groups, *alone):
            found = self._focal_of(group)
            names = [name for name in group.names if name in focal]
            if found is not None and not found[1] < MOST_UNCERTAIN * found[0]:
                for name in names:
                    del focal[name]
                    deviation.pop(name, None)
                continue
            if found is not None:
                f, s = found
                explained = group.agree or self._explains(group)
                s = s if explained else max(s, group.std)  # they may be of two zooms
                focal |= dict.fromkeys(names, f)
                deviation |= dict.fromkeys(names, s)
                group = dataclasses.replace(group, focal=f, std=s, agree=explained)
            if len(group.names) > 1:
                groups.append(group)
        origin = "bundle adjustment of the grid, which may be bent"
        return dataclasses.replace(
            focals, focal=focal, deviation=deviation, groups=tuple(groups), origin=origin, absent=_NO_FOCAL
        )

    def _focal_of(self, group: FocalGroup) -> tuple[float, float] | None:
        """Focal length and deviation of photos of one zoom; None if it sees none of them."""
        if any(name in self.lost for name in group.names):
            return np.nan, np.inf
        zooms = {int(self.number[self.names.index(name)]) for name in group.names if name in self.names}
        if not zooms:
            return None
        zoom = zooms.pop()
        return float(np.asarray(self.fit.focal)[zoom]), float(np.asarray(self.fit.focal_std)[zoom])

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
        bundle adjustment. Before them are the focal length before the bundle adjustment, and by it.
        `label` is that of `lens`.
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
                    f"{first:.4g}",
                    f"{focal:.0f} ± {std:.0f}",
                    *(f"{value:+.2f}" if np.isfinite(value) else "" for value in moved),
                )
            )
        return rows

    def of_boards(self) -> list[str]:
        """The focal length that each board was seen at; none if some was seen at several."""
        board = np.asarray(self.fit.board)
        seen = [np.unique(self.number[board == one]) for one in range(len(self.fit.bend))]
        if len(seen) < 2 or any(len(zooms) != 1 for zooms in seen):
            return []
        return [f"f = {float(self.fit.focal[zooms[0]]):.0f} px" for zooms in seen]

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


class Made(NamedTuple):
    """What was made of the photos' grids.

    Attributes:
        bundle: the bundle adjustment; None if there is none.
        told: why there is none, or what would make it better, in a sentence; empty if nothing.
        contradicts: whether the photos, of one focal length each as was said, fit no board.
    """

    bundle: BoardBundle | None
    told: str
    contradicts: bool = False

    def of_one_zoom(self, groups: Sequence[FocalGroup]) -> bool:
        """Whether photos that are supposed to share a focal length may do so."""
        if self.bundle is None:
            return may_be_of_one_zoom(groups) and not self.contradicts
        fit, number = self.bundle.fit, len(self.bundle.names)
        precision = float(np.max(fit.focal_std / fit.focal))
        return not self.bundle.lost and may_be_of_one_zoom(groups, number, precision)


def bundle_of(
    used: Sequence[Detection],
    focals: Focals,
    centre: CentreArgument = "fit",
    sharing: Collection[str] = (),
) -> Made:
    """The bundle adjustment of the photos' grids, if there are enough of them.

    Photos of one focal length are of one zoom. Where each has its own, as homographies give it, twelve
    determine their focal lengths and the board's shape together.

    Args:
        used: the photos.
        focals: their focal lengths.
        centre: of distortion.
        sharing: ways by which photos could share a focal length that have not been asked for: of
            `SHARED_BY`.
    """
    of = [d for d in used if d.nodes is not None and np.isfinite(d.nodes[..., 0]).sum() >= _CORNERS]
    if not of:
        return Made(
            None, f"The shape of the board was not fitted: no photo shows {_CORNERS} of its corners."
        )
    shape, _ = Counter(d.nodes.shape for d in of if d.nodes is not None).most_common(1)[0]
    of = [d for d in of if d.nodes is not None and sorted(d.nodes.shape) == sorted(shape)]
    label = np.array([focals.focal[d.name] for d in of])
    if not _enough(label):
        return Made(None, _too_few(of, label, focals, sharing))
    fit, kept = _fitted(of, [np.rot90(np.asarray(d.nodes), _turn(d, shape)) for d in of], label, centre)
    if bool(failed(fit.fit.result)) or not np.isfinite(float(fit.fit.rms)):
        return Made(None, _NO_MINIMUM, True)
    if not _enough(label[kept]):
        if focals.origin == GRID:
            return Made(None, _UNDETERMINED, True)
        kept = np.ones(len(of), bool)  # their focal lengths are known
    lost = tuple(d.name for d, there in zip(of, kept, strict=True) if not there)
    keeping = _keeping(used, of, focals)
    of, label = [d for d, there in zip(of, kept, strict=True) if there], label[kept]
    flat = flat_detections(fit, of, [_turn(d, shape) for d in of])
    seen, even = (lines_of(some, label, focals.unit) for some in (of, flat))
    straight = straightness(fit, seen, even, centre)
    number = np.unique(label, return_inverse=True)[1]
    before = "of homographies" if focals.origin == GRID else "of the photos"
    names = tuple(d.name for d in of)
    bundle = BoardBundle(fit, names, lost, number, focals.unit, before, tuple(flat), straight)
    better = sharing_options(of, focals, {*sharing} - {"similarity"})
    told = f"Each photo has a focal length of its own: {better} makes them more precise." if better else ""
    return Made(bundle, " ".join(filter(None, (told, keeping))))


def _turn(detection: Detection, shape: tuple[int, ...]) -> int:
    """The quarters by which a grid is to be turned, so that its corners are those of grids of this shape.

    Whichever way round it is seen, the detector begins at a dark square. One that was seen on its side is
    turned so that it does so then, too.
    """
    if detection.nodes is None or detection.nodes.shape == shape:
        return 0
    return 1 if detection.nodes.shape[1] % 2 == 0 else 3


def _keeping(used: Sequence[Detection], of: Sequence[Detection], focals: Focals) -> str:
    """Which photos keep the focal lengths of homographies, in a sentence; empty if none."""
    known = {focals.focal[d.name] for d in of}
    names = [plain(d.name) for d in used if focals.focal[d.name] not in known]
    if focals.origin != GRID or not names:
        return ""
    listed = ", ".join(names[:_MOST_NAMES]) + (", ..." if len(names) > _MOST_NAMES else "")
    one = len(names) == 1
    photos = "1 photo keeps the focal length" if one else f"{len(names)} photos keep the focal lengths"
    why = f"{'it shows' if one else 'they show'} another grid, or too few of its corners"
    return f"{photos} of homographies, as of a flat board, as {why}: {listed}."


def _enough(label: np.ndarray) -> bool:
    """Whether the board's shape can be told from the lens."""
    _, counts = np.unique(label, return_counts=True)
    return len(label) >= _IN_ALL or (len(label) > 0 and int(counts.min()) >= _A_ZOOM)


def _fitted(
    of: Sequence[Detection], grids: Sequence[np.ndarray], label: np.ndarray, centre: CentreArgument
) -> tuple[BoardFit, np.ndarray]:
    """The fit, and which photos are in it: without those whose focal lengths nothing determines.

    Where too few are left, it is the fit of all.
    """

    def fitted(there: np.ndarray) -> BoardFit:
        _, number, counts = np.unique(label[there], return_inverse=True, return_counts=True)
        return fit_boards(
            [grid for grid, one in zip(grids, there, strict=True) if one],
            label[there],
            image_size=of[0].image_size,
            centre=centre,
            board=number if counts.min() >= _OWN_SHAPE else None,
            throw=False,
        )

    every = np.ones(len(of), bool)
    fit = fitted(every)
    number = np.unique(label, return_inverse=True)[1]
    kept = (np.asarray(fit.focal_std) < MOST_UNCERTAIN * np.asarray(fit.focal))[number]
    if kept.all() or bool(failed(fit.fit.result)) or not _enough(label[kept]):
        return fit, kept
    return fitted(kept), kept


def _too_few(of: Sequence[Detection], label: np.ndarray, focals: Focals, sharing: Collection[str]) -> str:
    """Why there is no bundle adjustment, and what to do."""
    number, zooms = len(label), len(np.unique(label))
    photos = f"{number} photo{'s' * (number > 1)} at {zooms} focal length{'s' * (zooms > 1)}"
    shared = sharing_options(of, focals, sharing)
    more = f" If some are of one zoom, say so: {shared[:-1]}." if shared else ""
    return (
        f"The board counts as flat: {photos} cannot separate its shape from the lens. That takes {_A_ZOOM} "
        f"at each, or {_IN_ALL} in all.{more}"
    )


def sharing_options(of: Sequence[Detection], focals: Focals, sharing: Collection[str]) -> str:
    """The options that would say which photos are of one zoom; empty if there are none, or no need.

    They end in a comma.
    """
    exif, folders = Counter(d.focal for d in of if d.focal), Counter(Path(d.file).parent for d in of)
    one_folder = len(of) < _IN_ALL and focals.one_zoom is None
    if focals.origin != GRID or focals.one_zoom or len(of) < 2:
        return ""
    if "exif" in sharing and max(exif.values(), default=0) > 1:
        return "--focal plane --shared-focal exif, for photos of one focal length in their EXIF data,"
    if "folder" in sharing and max(folders.values()) > 1 and (len(folders) > 1 or one_folder):
        return "--focal plane --shared-focal folder, if the photos of a folder are of one zoom,"
    return "--focal plane --shared-focal similarity," if "similarity" in sharing else ""
