"""Rendered photos of the paper's first experiment, as files like those of a camera."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from .._core.files import whole_file
from ..correct.image import undistort_image
from ..io.exif import exif_with_focal
from ..models.lens import ZoomLens
from ..scenes.board import board_photo, focal_sweep, nikkor_18_200

IMAGE_SIZE = (2144, 1424)
"""px: half the size of the paper's images, with the same field of view."""

_QUALITY = 92

_THREADS = 4
"""Photos that are rendered at a time, at most: one of 12 megapixels takes a gigabyte."""


def write_photos(
    folder: str | os.PathLike[str],
    *,
    number: int = 12,
    image_size: tuple[int, int] = IMAGE_SIZE,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Render photos of the striped board at focal lengths over the range of the lens, as JPEG files.

    The lens is the paper's, from its published polynomials. Photos have a blur of 0.8 px, noise of 2 grey
    levels, vignetting, and the focal length in their EXIF data.
    """
    # Single precision puts borders within 0.0001 px, a hundredth of a grey level, in half of the time.
    lens = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), nikkor_18_200(image_size))
    Path(folder).mkdir(parents=True, exist_ok=True)
    paths = [Path(folder) / name for name in photo_names(number)]
    focals = _focal(number).tolist()

    def render(index: int) -> None:
        photo = board_photo(lens, focals[index], blur=0.8, noise=2, vignetting=0.3, seed=seed + index)
        exif = np.frombuffer(exif_with_focal(focals[index]), np.uint8)
        done, content = cv2.imencodeWithMetadata(
            ".jpg", photo, [cv2.IMAGE_METADATA_EXIF], [exif], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        )
        assert done
        with whole_file(paths[index]) as part:
            part.write_bytes(content.tobytes())

    render(0)  # which compiles the program of all
    progress(1, number)
    with ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:
        for done, _ in enumerate(pool.map(render, range(1, number)), start=2):
            progress(done, number)
    return paths


def photo_names(number: int) -> list[str]:
    """The file names that `write_photos` gives to this number of photos."""
    return [f"board-{focal:06.2f}mm.jpg" for focal in _focal(number)]


def _focal(number: int) -> np.ndarray:
    return np.round(focal_sweep(number), 2)


def write_before_after(photo: Path, target: Path, lens: ZoomLens, focal: float) -> None:
    """Write a picture of one photo next to its correction."""
    image = cv2.imread(str(photo), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    assert image is not None
    both = [image, undistort_image(image, lens(focal), keep="valid", interpolation="cubic")]
    scale = 900 / image.shape[1]
    halves = []
    for picture, title in zip(both, (f"{photo.name}", "corrected"), strict=True):
        size = (900, round(image.shape[0] * scale))
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        bar = np.full((36, size[0], 3), 255, np.uint8)
        cv2.putText(bar, title, (10, 25), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (40, 40, 40), 1, cv2.LINE_AA)
        halves.append(np.vstack([bar, small]))
    gap = np.full((halves[0].shape[0], 12, 3), 255, np.uint8)
    done, content = cv2.imencode(".jpg", np.hstack([halves[0], gap, halves[1]]))
    assert done
    with whole_file(target) as part:
        part.write_bytes(content.tobytes())


def worst_error(lens: ZoomLens, truth: ZoomLens, focal: Iterable[float]) -> float:
    """The largest distance between two lenses' corrections, px, on 20 x 20 points per focal length."""
    width, height = truth.image_size
    x, y = np.meshgrid(np.linspace(0, width - 1, 20), np.linspace(0, height - 1, 20))
    grid = jnp.asarray(np.stack([x, y], axis=-1))
    worst = 0.0
    for f in focal:
        apart = lens(float(f)).undistort(grid) - truth(float(f)).undistort(grid)
        worst = max(worst, float(jnp.max(jnp.hypot(apart[..., 0], apart[..., 1]))))
    return worst
