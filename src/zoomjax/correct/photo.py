"""Correction of photo files at the focal length in their EXIF data, with their metadata.

Pixels are used as stored, before rotation by the orientation tag, because the lens model refers to these.
The tag is copied with the other metadata, so that the result is shown the same way up. A mark in the XMP
packet tells that a photo is corrected, so that it is not corrected twice.
"""

import contextlib
import dataclasses
import hashlib
import os
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

import jax
import numpy as np

from .._core.arguments import kinds_checked
from .._core.files import refuse_inputs, whole_file
from .._core.text import listed
from ..io.metadata import (
    Metadata,
    framing_of,
    geometry_of,
    has_no_place,
    marked,
    not_corrected_again,
    straightened_by,
    with_size,
)
from ..io.photo import (
    FORMATS,
    Photo,
    metadata_focal,
    open_photo,
    read_focal,
    read_metadata,
    read_pages,
    read_size,
)
from ..io.photo_writer import check_written, encoded_photo
from ..models.about import UNKNOWN
from ..models.lens import ZoomLens
from ..models.sizes import check_aspect, lens_for_size
from .framing import Framing, frame_output, framing_for_size
from .image import undistort_image
from .redistort import framing_of_corrected, redistort_image


@dataclasses.dataclass(frozen=True)
class Correction:
    """What is done to photos.

    Attributes:
        lens: the lens; for another size of the same aspect ratio it is scaled.
        keep: what to show, given a photo's size.
        interpolation, border: as for `undistort_image`.
        back: whether corrected photos are given, and distortion is applied.
        again: whether photos are accepted that carry the mark of the same geometry.
        shown: what `keep` depends on besides the lens and a photo's size, as text.
    """

    lens: ZoomLens
    keep: Callable[[tuple[int, int]], str | Framing] = lambda size: "same"
    interpolation: str = "linear"
    border: str = "constant"
    back: bool = False
    again: bool = False
    shown: str = ""

    def work(self, source: str | os.PathLike[str], focal: float | int) -> str:
        """What the result for a photo at a focal length depends on, as hexadecimal digits.

        Raises:
            OSError, ValueError: the photo cannot be read, as `open_photo` says.
        """
        lens = self.lens
        kinds = [type(of).__qualname__ for of in (lens, lens.zoom, lens.distortion_model)]
        options = (self.geometry, self.shown, self.interpolation, self.border, float(focal))
        digest = hashlib.sha256(repr((kinds, lens.image_size, lens.focal_unit, options)).encode())
        for leaf in jax.tree.leaves(lens):
            array = np.asarray(leaf)
            digest.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
        with open_photo(Path(source)) as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
        return digest.hexdigest()[:32]

    @property
    def geometry(self) -> str:
        """What the photos are afterwards, as the mark has it."""
        return "distorted" if self.back else "undistorted"

    def framing(self, image: np.ndarray, focal: float | int) -> tuple[float, float, float]:
        """Scale and origin of the framing of the corrected one of both images."""
        size = (image.shape[1], image.shape[0])
        framing = self.keep(size)
        if framing == "same":
            return 1.0, 0.0, 0.0
        if not isinstance(framing, Framing):
            with warnings.catch_warnings():  # the correction warns of the same
                warnings.simplefilter("ignore")
                framing = (
                    framing_of_corrected(self.lens, focal, framing, size)
                    if self.back
                    else frame_output(lens_for_size(self.lens, size)(focal), size, keep=framing)
                )
        x, y = (float(value) for value in np.asarray(framing.origin))
        return float(framing.scale), x, y

    def __call__(self, image: np.ndarray, focal: float | int) -> np.ndarray:
        """The corrected image, at a focal length in the lens's unit."""
        keep = self.keep((image.shape[1], image.shape[0]))
        warp = redistort_image if self.back else undistort_image
        return warp(
            image, self.lens, focal=focal, keep=keep, interpolation=self.interpolation, border=self.border
        )


@kinds_checked
def undistort_photo(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    lens: ZoomLens,
    focal: float | int | None = None,
    keep: str | Framing = "same",
    interpolation: str = "linear",
    border: str = "constant",
    again: bool = False,
) -> None:
    """Correct a photo and write it to a new file, with its metadata and a mark in its XMP.

    Args:
        source: the photo: JPEG, PNG, WebP, TIFF, BMP or AVIF; HEIC with the extra ``heic``, RAW with
            ``raw``. All its bits and channels are kept, and all pages of a TIFF file.
        target: the file to write, completely or not at all. Its suffix sets the format; JPEG in quality 97.
        lens: the lens; for another size of the same aspect ratio it is scaled.
        focal: focal length in the lens's unit; by default that in the EXIF data.
        keep: as for `undistort_image`; a `Framing` for images of another size is scaled as the lens is.
        interpolation, border: as for `undistort_image`.
        again: whether to correct a photo whose mark tells that it is corrected.

    Raises:
        FileNotFoundError: there is no such photo.
        OSError: the target cannot be written; nothing is left of it.
        ValueError: the photo cannot be decoded, is in the colours of print (CMYK) or Lab, has no focal
            length, is corrected already, or has another aspect ratio than the lens; or the target is the
            photo itself, its suffix is unknown, or its format cannot store such pixels or several pages.

    Warns:
        UserWarning: as `undistort_image` and `ZoomLens` do; metadata are lost, as IPTC data in PNG; or
            the photo says that another program has corrected its distortion before.
    """
    correction = Correction(lens, _scaled(keep), interpolation, border, again=again, shown=repr(keep))
    _convert(source, target, focal, correction)


@kinds_checked
def redistort_photo(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    lens: ZoomLens,
    focal: float | int | None = None,
    keep: str | Framing = "same",
    interpolation: str = "linear",
    border: str = "constant",
    again: bool = False,
) -> None:
    """Apply distortion to a corrected photo, as `redistort_image`, and write it to a new file.

    Arguments and errors are those of `undistort_photo`; `keep` says how the photo was corrected.
    """
    correction = Correction(lens, _scaled(keep), interpolation, border, True, again, shown=repr(keep))
    _convert(source, target, focal, correction)


def _scaled(keep: str | Framing) -> Callable[[tuple[int, int]], str | Framing]:
    def framing(size: tuple[int, int]) -> str | Framing:
        if not isinstance(keep, Framing) or size == keep.size:
            return keep
        return framing_for_size(keep, size)

    return framing


def _convert(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    focal: float | int | None,
    correction: Correction,
) -> None:
    target = Path(target)
    check_target(target)
    refuse_inputs([target], [source])
    content, lost = corrected_photo(source, target.suffix, correction, focal)
    if lost:
        warnings.warn(not_kept(source, target.suffix, lost), stacklevel=3)
    for told in () if correction.back else corrected_before([source]):
        warnings.warn(told, stacklevel=3)
    with whole_file(target) as part:
        part.write_bytes(content)


def corrected_before(sources: Sequence[str | os.PathLike[str]]) -> tuple[str, ...]:
    """That photos say that another program has corrected them before, in a sentence; none if none does.

    Photos that cannot be read say nothing.
    """
    programs: Counter[str] = Counter()
    for source in sources:
        with contextlib.suppress(OSError, ValueError):
            programs[straightened_by(read_metadata(source)) or ""] += 1
    told = [name for name in programs if name not in ("", "zoomjax")]
    if not told:
        return ()
    one, number = len(sources) == 1, sum(programs[name] for name in told)
    who = f"{os.fspath(sources[0])} says" if one else f"Of {len(sources)} photos {number} say"
    whose, they = ("its", "it is") if one else ("their", "they are")
    return (
        f"{who} that {listed(told, 3)} has corrected {whose} distortion before. Unless the lens was "
        f"calibrated from such photos, {they} corrected twice now.",
    )


def check_target(target: Path) -> None:
    """Refuse names of files that are no photographs.

    Raises:
        ValueError: the suffix is unknown.
    """
    if target.suffix.lower() not in FORMATS:
        raise ValueError(
            f"Argument target must end in one of {', '.join(FORMATS)}, but it is {target.name!r}."
        )


def _check_framing(
    source: str | os.PathLike[str],
    used: tuple[float, float, float],
    before: tuple[float, float, float],
    shape: tuple[int, ...],
) -> None:
    """Refuse another framing than the one that a photo was corrected with, which may have the same size."""
    reach = max(shape[:2])
    apart = abs(used[0] / before[0] - 1) * reach + max(abs(used[1] - before[1]), abs(used[2] - before[2]))
    if apart > _SAME_FRAMING:
        raise ValueError(
            f"{os.fspath(source)} was corrected with another framing, of scale {before[0]:.6g} and origin "
            f"({before[1]:.6g}, {before[2]:.6g}) px. Give the argument keep that it was corrected with; of "
            "photos that were corrected together, give all of them."
        )


_SAME_FRAMING = 0.05
"""px by which framings may differ: by rounding."""


def not_kept(source: str | os.PathLike[str], suffix: str, lost: list[str]) -> str:
    """A sentence about what a photo loses."""
    return f"Not kept of {os.fspath(source)} in a {suffix} file: {', '.join(lost)}."


def corrected_photo(
    source: str | os.PathLike[str], suffix: str, correction: Correction, focal: float | int | None
) -> tuple[bytes, list[str]]:
    """What `undistort_photo` writes into a file with that suffix, and names of what it does not hold.

    Raises what `undistort_photo` raises of the source.
    """
    photo = read_pages(source)
    _check(photo, source, suffix, correction)
    if focal is None:
        known = metadata_focal(photo.pages[0][1]) if correction.lens.focal_unit == "mm" else None
        focal = _known(known, source, correction.lens)
    work = correction.work(source, focal)
    pages: list[tuple[np.ndarray, Metadata]] = []
    more = ["XMP, which is damaged"] if any(has_no_place(metadata) for _, metadata in photo.pages) else []
    for image, metadata in photo.pages:
        framing, before = correction.framing(image, focal), framing_of(metadata)
        if correction.back and before is not None:
            _check_framing(source, framing, before, image.shape)
        done = correction(image, focal)
        told = with_size(metadata, _size(image), _size(done))
        kept = told if correction.back else not_corrected_again(told)
        more += [_ADOBE] if kept is not told else []
        mark = marked(kept, correction.geometry, work, None if correction.back else framing)
        pages.append((done, mark))
    with _blamed(source):
        content, lost = encoded_photo(pages, suffix)
    mark_alone = not any(metadata.xmp for _, metadata in photo.pages)
    lost = [name for name in lost if not (name == "XMP" and mark_alone)]
    return content, [*lost, *photo.others, *dict.fromkeys(more)]


def _size(image: np.ndarray) -> tuple[int, int]:
    return image.shape[1], image.shape[0]


_ADOBE = "the order to Adobe's programs to correct the lens, which would have been done once more"


def _check(photo: Photo, source: str | os.PathLike[str], suffix: str, correction: Correction) -> None:
    name = os.fspath(source)
    if photo.colours:
        raise ValueError(f"{name} is in {photo.colours}, which are not kept: convert it to RGB first.")
    _refuse_done(source, photo.pages[0][1], correction)
    with _blamed(source):
        check_written(photo.pages, suffix)


def _refuse_done(source: str | os.PathLike[str], metadata: Metadata, correction: Correction) -> None:
    if not correction.again and geometry_of(metadata) == correction.geometry:
        raise ValueError(
            f"{os.fspath(source)} is {correction.geometry} by zoomjax already. Give the original, or "
            "argument again."
        )


def check_ahead(source: str | os.PathLike[str], correction: Correction) -> None:
    """Refuse a photo that a correction refuses by what its header says. No pixel is decoded.

    Raises:
        FileNotFoundError: there is no such photo.
        ValueError: its header cannot be read; or it is corrected already, or has another aspect ratio than
            the lens.
    """
    _refuse_done(source, read_metadata(source), correction)
    size = read_size(source)
    if correction.back and correction.shown.startswith("grow"):
        correction.keep(size)  # of another shape than the lens's images, and looked at there
    else:
        check_aspect(size, correction.lens.image_size)


@contextlib.contextmanager
def _blamed(source: str | os.PathLike[str]) -> Generator[None, None, None]:
    """Errors of writing name the photo."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"Cannot write the result of {os.fspath(source)}: {error}.") from error


def photo_focal(source: str | os.PathLike[str], lens: ZoomLens) -> float:
    """The focal length in a photograph's EXIF data, for a lens in mm. No pixel is decoded.

    For a lens whose own focal length is not known, as `ZoomLens.about` says, the number that stands for it.

    Raises:
        FileNotFoundError: there is no such photograph.
        ValueError: it cannot be read or tells none, or the lens is in px.
    """
    return _known(read_focal(source) if lens.focal_unit == "mm" else None, source, lens)


def _known(focal: float | None, source: str | os.PathLike[str], lens: ZoomLens) -> float:
    if lens.about.get("focal") == UNKNOWN:
        return float(lens.focal_range[0])
    if focal is None:
        raise ValueError(
            f"The focal length of {os.fspath(source)} is not known: its EXIF data have none in "
            f"{lens.focal_unit}. Give it (argument focal)."
        )
    return focal
