"""STMaps: images whose pixels say where to sample another image, as Nuke, Fusion, Flame and Blender use.

Two for each focal length: ``undistort`` says for a pixel of the corrected image where it is in the
distorted one, ``redistort`` the other way round. Red is ``(x + 0.5)/w``, green ``1 - (y + 0.5)/h``, from
the bottom left corner; 32-bit float. Blue is 1 where there is something to sample, else 0: Blender takes it
for the opacity, others leave it out. The corrected image of a barrel lens is larger than the photo: the
data window of ``undistort`` is its bounding box (overscan), the display window that of the photo.

Two writers put positions elsewhere, `convention`: "gyroflow" has x/w and 1 - y/h, "alicevision" x/(w - 1)
and 1 - y/(h - 1).
"""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from .._core.quiet import silent
from ..models.distortion import Distortion
from ..models.distortion_model import AbstractRadial
from ._samples import border, distortions
from .base import (
    CONVENTION,
    IN_PX,
    Contents,
    Export,
    FolderFormat,
    Import,
    Sampled,
    one_size,
    refuse_others,
)

_ROWS = 128
"""Of a map that are computed at once."""

_KNOTS = 2049
"""Of the spline that stands for a radial map."""

_SAMPLED = 40
"""Pixels along each side that a lens is fitted to."""

_LEAST = 0.05
"""Share of a map's pixels that must lie within the image."""

_FOCAL, _UNIT = "zoomjaxFocal", "zoomjaxFocalUnit"
_DIRECTION, _CONVENTION = "zoomjaxDirection", "zoomjaxConvention"
"""Attributes of the header, of maps that zoomjax wrote."""

CONVENTIONS = {"centres": (0.5, 0), "gyroflow": (0.0, 0), "alicevision": (0.0, -1)}
"""What is added to pixel positions, and to the size."""

DIRECTIONS = ("undistort", "redistort")
"""Of maps, as they are in file names."""

_OUTSIDE = -1.0
"""Where there is nothing to sample."""


class STMap(FolderFormat):
    """Pairs of EXR maps, one pair for each focal length or frame."""

    name, tools, suffixes = "stmap", "Nuke, Natron, Fusion, Flame, Blender, After Effects", (".exr",)
    exact = True
    options = ("convention", "direction", "focal")

    def file_names(self, job: Export) -> list[str]:
        """Two for each node."""
        return [f"{kind}.{stem}.exr" for stem in job.stems for kind in DIRECTIONS]

    def write_all(self, job: Export, folder: Path) -> tuple[float, tuple[str, ...]]:
        """The maps; returns the greatest error of rounding and of what is quicker than the lens, px."""
        names = iter(self.file_names(job))
        focal = job.focal or ()
        each = distortions(job.lens, np.array(focal))
        size, worst = job.lens.image_size, 0.0
        window = _union([_corrected_window(d, size) for d in each])
        for f, distortion in zip(focal, each, strict=True):
            header = {_FOCAL: float(f), _UNIT: job.lens.focal_unit, _CONVENTION: job.convention}
            boxes = (window, (0, 0, size[0] - 1, size[1] - 1))
            for method, box, direction in zip(("distort", "undistort"), boxes, DIRECTIONS, strict=True):
                header[_DIRECTION] = direction
                found, error = _quick(distortion, method, box)
                rounding = _write_map(folder / next(names), found, box, size, job.convention, header)
                worst = max(worst, error + rounding)
        return worst, _overscan(window, size)

    def recognises(self, head: str) -> bool:
        """By EXR's magic number."""
        return head.startswith("v/1\x01")

    def read(self, job: Import) -> Contents:
        """One map a focal length, of one direction; the others of a folder are left out."""
        nodes, units, sizes = [], set(), []
        wanted, paths = _of_one_direction(job)
        if job.focal is not None and len(job.focal) != len(paths):
            raise ValueError(f"argument focal must hold {len(paths)} focal lengths, one for each file")
        for number, path in enumerate(paths):
            header, red, green = _open(path)
            refuse_others(header, {"pixelAspectRatio": 1})
            sizes.append(size := job.size(_window_size(header["displayWindow"])))
            given = None if job.focal is None else job.focal[number]
            if (focal := _told("focal", header, _FOCAL, given)) is None:
                raise ValueError(
                    f"it does not say its focal length: give argument focal, one for each file{IN_PX}"
                )
            convention = _told("convention", header, _CONVENTION, job.convention) or CONVENTION
            points = _pairs(header, red, green, size, wanted, convention)
            nodes.append(Sampled(float(focal), *points, corrects=wanted == "redistort"))
            units.add(str(header.get(_UNIT, job.focal_unit)))
        if len(units) > 1:
            raise ValueError(f"some of its focal lengths are in {' and some in '.join(sorted(units))}")
        return Contents(tuple(nodes), one_size(sizes), units.pop())


def to_map(points: np.ndarray, size: tuple[int, int], convention: str) -> np.ndarray:
    """Positions in px as red and green."""
    add, more = CONVENTIONS[convention]
    share = (points + add) / (np.array(size) + more)
    return np.stack([share[..., 0], 1 - share[..., 1]], axis=-1)


def from_map(values: np.ndarray, size: tuple[int, int], convention: str) -> np.ndarray:
    """Red and green as positions in px."""
    add, more = CONVENTIONS[convention]
    share = np.stack([values[..., 0], 1 - values[..., 1]], axis=-1)
    return share * (np.array(size) + more) - add


def _corrected_window(distortion: Distortion, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """The pixels that the corrected image and the display window cover: x and y of both ends."""
    ends = border(size, np.asarray(distortion.centre)) + np.asarray(distortion.centre)
    corrected = np.asarray(distortion.undistort(ends))
    if not np.isfinite(corrected).all():
        raise ValueError(
            "The lens folds over within the image, and has no corrected border there: zj.models.certify "
            "says where. Export focal lengths at which it does not."
        )
    low = np.minimum(np.floor(corrected.min(0)), 0)
    high = np.maximum(np.ceil(corrected.max(0)), np.array(size) - 1)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _union(windows: list[tuple[int, int, int, int]]) -> tuple[int, int, int, int]:
    table = np.array(windows)
    return (*(int(v) for v in table[:, :2].min(0)), *(int(v) for v in table[:, 2:].max(0)))  # pyright: ignore[reportReturnType]


def _overscan(window: tuple[int, int, int, int], size: tuple[int, int]) -> tuple[str, ...]:
    """What those should know whose tool has no data windows."""
    width, height = window[2] - window[0] + 1, window[3] - window[1] + 1
    if (width, height) == size:
        return ()
    return (
        f"Corrected images are {width}x{height} px: the photo's frame begins {-window[0]} px from the left "
        f"and {-window[1]} px from the top.",
    )


def _quick(
    distortion: Distortion, method: str, window: tuple[int, int, int, int]
) -> tuple[Callable[[np.ndarray], Any], float]:
    """``distort`` or ``undistort``, of millions of points: if radial, by a spline of the squared radius.

    With so many knots it is within rounding errors of 32-bit floats: its greatest error on a ray, px, comes
    second.
    """
    exact = getattr(distortion, method)
    if not isinstance(distortion.distortion_model, AbstractRadial):
        return exact, 0.0
    centre, scale = np.asarray(distortion.centre), float(distortion.scale)
    corners = np.array(np.meshgrid(window[::2], window[1::2])).reshape(2, -1).T - centre
    t = np.linspace(0, 1.001 * np.max(np.sum(corners**2, -1)), _KNOTS) / scale**2
    radius = np.sqrt(t[1:])
    ratio = (exact(centre + scale * radius[:, None] * np.array([1.0, 0.0])) - centre)[:, 0] / scale / radius
    if not np.isfinite(ratio).all():
        return exact, 0.0
    spline = CubicSpline(t, np.append(1.0, ratio))

    def found(points: np.ndarray) -> np.ndarray:
        z = points - centre
        return centre + z * spline(np.sum(z * z, -1) / scale**2)[..., None]

    ray = centre + scale * np.sqrt((t[1:] + t[:-1]) / 2)[:, None] * np.array([0.6, 0.8])
    return found, float(np.abs(found(ray) - np.asarray(exact(ray))).max())


def _write_map(
    path: Path,
    map_of: Any,
    window: tuple[int, int, int, int],
    size: tuple[int, int],
    convention: str,
    header: dict[str, Any],
) -> float:
    """Write one map; return the greatest rounding error, px."""
    OpenEXR = open_exr()
    x = np.arange(window[0], window[2] + 1, dtype=float)
    pixels = np.zeros((window[3] - window[1] + 1, len(x), 3), np.float32)
    worst = 0.0
    for first in range(0, len(pixels), _ROWS):
        y = np.arange(first, min(first + _ROWS, len(pixels)), dtype=float) + window[1]
        grid = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1)
        found = to_map(np.asarray(map_of(grid)), size, convention)
        exists = np.isfinite(found)
        rows = pixels[first : first + len(y)]
        rows[..., :2] = np.where(exists, found, _OUTSIDE)
        rows[..., 2] = exists.all(axis=-1)
        rounding = np.where(exists, abs(rows[..., :2] - found), 0) * np.array(size)
        worst = max(worst, float(np.hypot(*np.moveaxis(rounding, -1, 0)).max()))
    about = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "dataWindow": (window[:2], window[2:]),
        "displayWindow": ((0, 0), (size[0] - 1, size[1] - 1)),
        **header,
    }
    with OpenEXR.File(about, {"RGB": pixels}) as file:
        file.write(str(path))
    return worst


def open_exr() -> Any:
    """The module OpenEXR."""
    try:
        import OpenEXR
    except ModuleNotFoundError as error:
        raise ValueError('EXR files need the extra "interop": pip install "zoomjax[interop]".') from error
    return OpenEXR


_DAMAGED = "it is no EXR file, or it is damaged or cut off"


def _header(path: Path) -> dict[str, Any]:
    with _opened(path, header_only=True) as file:
        return dict(file.header())


def _open(path: Path) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Header, red and green of a map."""
    with _opened(path, separate_channels=True) as file:
        if not file.parts:
            raise ValueError(_DAMAGED)
        channels, header = file.channels(), dict(file.header())
        if not {"R", "G"} <= set(channels):
            raise ValueError(f"it has no channels R and G, but {', '.join(channels)}")
        return header, np.array(channels["R"].pixels, float), np.array(channels["G"].pixels, float)


@contextlib.contextmanager
def _opened(path: Path, **how: bool) -> Iterator[Any]:
    """An EXR file; OpenEXR's own complaints about a damaged one are not printed."""
    module = open_exr()
    try:
        with silent():
            file = module.File(str(path), **how)
    except RuntimeError as error:
        raise ValueError(_DAMAGED) from error
    with file:
        yield file


def _window_size(window: Any) -> tuple[int, int]:
    low, high = np.asarray(window)
    return int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)


def _told(argument: str, header: dict[str, Any], attribute: str, given: Any) -> Any:
    """What is given, or the header of our own maps tells; ValueError if they are not the same."""
    told = header.get(attribute)
    if told is None or given is None:
        return given if told is None else told
    here, there = (f"{v:.6g}" if isinstance(v, float) else str(v) for v in (told, given))
    if here != there:
        raise ValueError(f"its {argument} is {here}: leave out argument {argument}, which is {there}")
    return given


def _of_one_direction(job: Import) -> tuple[str, list[Path]]:
    """The direction that is read, and its files: those that tell it, by themselves or by name, else all."""
    headers = [_header(path) for path in job.paths]
    told = [
        header.get(_DIRECTION) or next((way for way in DIRECTIONS if way in path.name.lower()), None)
        for path, header in zip(job.paths, headers, strict=True)
    ]
    wanted = job.direction or told[0]
    if wanted is None:
        raise ValueError(
            'its name does not say its direction: give argument direction, "undistort" or "redistort"'
        )
    found = [path for path, way in zip(job.paths, told, strict=True) if way == wanted]
    if not found and None not in told:
        raise ValueError(f"its direction is {told[0]}: leave out argument direction, which is {wanted}")
    focal = {way: [h.get(_FOCAL) for h, w in zip(headers, told, strict=True) if w == way] for way in told}
    if job.direction is None and any(set(of) != set(focal[wanted]) for of in focal.values()):
        raise ValueError(
            "its maps of the two directions are not of the same focal lengths: give argument direction, "
            '"undistort" or "redistort"'
        )
    return wanted, found or list(job.paths)


def _pairs(
    header: dict[str, Any],
    red: np.ndarray,
    green: np.ndarray,
    size: tuple[int, int],
    direction: str,
    convention: str,
) -> tuple[np.ndarray, np.ndarray]:
    """Distorted and corrected points, px, thinned out, within the photo."""
    left, top = np.asarray(header["dataWindow"])[0] - np.asarray(header["displayWindow"])[0]
    rows, columns = (
        np.unique(np.linspace(0, n - 1, min(n, _SAMPLED)).round().astype(int)) for n in red.shape
    )
    grid = np.stack(np.broadcast_arrays(columns + float(left), rows[:, None] + float(top)), -1).reshape(
        -1, 2
    )
    values = np.stack([red, green], -1)[rows][:, columns].reshape(-1, 2)
    other = from_map(values, size, convention)
    distorted, corrected = (other, grid) if direction == "undistort" else (grid, other)
    inside = np.all((distorted >= -0.5) & (distorted <= np.array(size) - 0.5), axis=-1)
    inside &= np.all(np.isfinite(corrected), axis=-1)
    inside &= np.any(values != 0, axis=-1)  # black, as programs fill what shows nothing
    if inside.mean() < _LEAST:
        raise ValueError("hardly any of its pixels lies within the image: is the convention right?")
    return distorted[inside], corrected[inside]
