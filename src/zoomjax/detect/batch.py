"""Detection in many images: in several processes or on an executor, with a cache. Bad images are skipped.

Only points are kept, at most one every `_SPACING` px of a line: detectors smooth over some px, so that
closer neighbours share their noise and add little information. They are rounded to steps of 1/1024 px, far
below any noise, which files then hold in a tenth of the space.
"""

import collections
import contextlib
import dataclasses
import functools
import hashlib
import inspect
import io
import math
from collections.abc import Generator, Iterable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import numpy as np

from .._core.executors import checked_executor, in_order, is_away
from .._core.files import whole_file
from .._core.steps import STEP
from .._core.text import reason
from ._small import of_small, small
from ._workers import LostError, Workers
from .base import AbstractDetector
from .edges import EdgeDetector
from .grid import GridDetector
from .pitch import PitchDetector
from .sources import Source

DETECTORS: dict[str, type[AbstractDetector]] = {
    "edges": EdgeDetector,
    "grid": GridDetector,
    "pitch": PitchDetector,
}
"""By name, as the command line calls them."""

_SPACING = 4.0
_SMALLEST = 32

_SECONDS = 300.0
"""Time limit for an image: the largest that is accepted takes less, on a slow machine."""


@dataclasses.dataclass(frozen=True)
class Detection:
    """The result of detection in one image.

    Attributes:
        name: name of the image.
        file: the image's path, or its name if it has none.
        image_size: (width, height) px; (0, 0) if it could not be read.
        lines: for each line an (n, 2) array of points, px.
        focal: the focal length from the image's EXIF data or the video's track, or None.
        nodes: (row, column, 2) px, the nodes of a checkerboard or grid of dots, if one was searched for and
            found: NaN where a dot is not seen.
        unexplained: share of the length of the strong long edges that no line explains, as in `Edges`; None
            for other detectors than `EdgeDetector`.
        problem: why the image cannot be used; empty if it can.
        bend: how bent the image was taken to be, as `Edges.bend`; None for other detectors.
    """

    name: str
    file: str = ""
    image_size: tuple[int, int] = (0, 0)
    lines: tuple[np.ndarray, ...] = ()
    focal: float | None = None
    nodes: np.ndarray | None = None
    problem: str = ""
    unexplained: float | None = None
    bend: tuple[float, float, float, float] | None = None


def detect(
    sources: Iterable[Source],
    detector: AbstractDetector,
    *,
    grid: str = "none",
    workers: int = 0,
    cache: Path | None = None,
    executor: Executor | None = None,
) -> Generator[Detection, None, None]:
    """Detect lines in each image, in order. Bad images are reported, as `Detection.problem`, and skipped.

    Args:
        sources: the images.
        detector: the detector of lines.
        grid: where to search also for a grid, from whose nodes the focal length can be estimated: in "all"
            images, those "without focal length", or "none".
        workers: number of processes. An image that crashes a process, or takes longer than five minutes, is
            reported as a problem. 0: detect in this process, without this protection.
        cache: folder of cached detections by the same detector; None: no cache. A detector of one's own is
            the same while its settings and the file that defines it are.
        executor: instead of `workers`, any executor of `concurrent.futures`: a task an image. Its workers
            read the images, and the cache, by the same paths; only lines come back. There is no limit of
            time.

    Raises:
        TypeError: `executor` is none.
        ValueError: there are both `executor` and `workers`.
        RuntimeError: no process can be started, or the executor gave up.
    """
    if executor is not None:
        if workers:
            raise ValueError(
                f"Argument workers is {workers}, and argument executor has its own: leave out one of both."
            )
        yield from _by_executor(checked_executor(executor), sources, detector, grid, cache)
        return
    task = functools.partial(_detected, detector=detector, grid=grid)
    code = _code(type(detector))
    with contextlib.ExitStack() as stack:
        submit = stack.enter_context(Workers(task, workers, _SECONDS)).submit if workers else task
        pending: collections.deque[tuple[_Entries | None, Source, Future | Detection]] = collections.deque()
        for source in sources:
            entries = _Entries.of(cache, source, detector) if cache and code else None
            known, missing = (None, True) if entries is None else _known(entries, source, detector, grid)
            if known is None or missing:
                pending.append((entries, source, submit(_Task(source, known))))
            else:
                pending.append((None, source, known))
            while len(pending) > 2 * workers or (pending and isinstance(pending[0][2], Detection)):
                yield _finished(*pending.popleft(), detector, grid)
        while pending:
            yield _finished(*pending.popleft(), detector, grid)


def _by_executor(
    executor: Executor,
    sources: Iterable[Source],
    detector: AbstractDetector,
    grid: str,
    cache: Path | None,
) -> Generator[Detection, None, None]:
    """The same on an executor: one task an image, with all reading in it."""
    place = None if cache is None else cache.absolute()
    task = functools.partial(_sent, detector=detector, grid=grid, cache=place)
    with contextlib.closing(
        in_order(executor, task, sources, size=_pixels, there=_absolute, file=lambda one: one.path)
    ) as done:
        for one in done:
            if one.result is None:
                yield Detection(one.item.name, one.item.file, problem=f"its task failed: {one.told()}")
            else:
                detection, lines = one.result
                yield dataclasses.replace(detection, file=one.item.file, lines=of_small(lines))


def _pixels(source: Source) -> int:
    return 0 if source.image is None else source.image.nbytes


def _absolute(source: Source) -> Source:
    """For a worker, which is in another folder."""
    return source if source.path is None else dataclasses.replace(source, path=source.path.absolute())


def _sent(
    source: Source, *, detector: AbstractDetector, grid: str, cache: Path | None
) -> tuple[Detection, bytes]:
    """In a worker: a detection, from the cache or not, and its lines apart, small."""
    if is_away():
        cv2.setNumThreads(1)  # workers share a machine's cores
    entries = _Entries.of(cache, source, detector) if cache and _code(type(detector)) else None
    known, missing = (None, True) if entries is None else _known(entries, source, detector, grid)
    if known is None or missing:
        found = _detected(_Task(source, known), detector=detector, grid=grid)
        known = _finished(entries, source, found, detector, grid)
    return dataclasses.replace(known, lines=()), small(known.lines)


class _Task(NamedTuple):
    """An image, and its lines where they are known and only a grid is searched for."""

    source: Source
    known: Detection | None


def _wants_grid(grid: str, detector: AbstractDetector, focal: float | None) -> bool:
    own = isinstance(detector, GridDetector)
    return own or grid == "all" or (grid == "without focal length" and focal is None)


def _detected(task: _Task, *, detector: AbstractDetector, grid: str) -> Detection:
    source, known = task
    found = functools.partial(Detection, source.name, source.file)
    try:
        image, focal = source.read()
    except Exception as error:  # any error concerns this image only
        return found(problem=reason(error).rstrip("."))
    size = (image.shape[1], image.shape[0])
    if min(size) < _SMALLEST:
        return found(problem=f"it is {size[0]}x{size[1]} px: at least {_SMALLEST} px a side are needed")
    if isinstance(detector, PitchDetector) and image.ndim == 2:
        return found(
            size, problem=f"it is grey, but the pitch detector finds grass by its colour. {_EDGES}"
        )
    try:
        focal = source.focal if focal is None else focal
        wanted = _wants_grid(grid, detector, focal)
        nodes = _grid_detector(detector).find(image) if wanted else None
        if known is not None:
            return dataclasses.replace(known, nodes=nodes)
        lines, unexplained, bend = _lines(detector, image, nodes, source.bend)
    except Exception as error:
        return found(
            size, problem=f"the detector failed: {type(error).__name__}: {reason(error).rstrip('.')}"
        )
    return found(size, lines, focal, nodes, "" if lines else NO_LINES, unexplained, bend)


def _grid_detector(detector: AbstractDetector) -> GridDetector:
    return detector if isinstance(detector, GridDetector) else GridDetector()


def _lines(
    detector: AbstractDetector, image: np.ndarray, nodes, known: tuple[float, ...] | None
) -> tuple[tuple[np.ndarray, ...], float | None, tuple[float, float, float, float] | None]:
    """The thinned lines, the share of edges that they leave unexplained, and how bent the image is."""
    if isinstance(detector, EdgeDetector):
        edges = detector.find(image, bend=known)
        return _thinned(edges.lines), edges.unexplained, edges.bend
    lines = detector.lines(nodes) if isinstance(detector, GridDetector) else detector(image)
    return _thinned(lines), None, None


_EDGES = "Try another detector, such as edges (argument detector)"

NO_LINES = (
    "no lines were found. Check that straight edges are in focus, well lit and large in the image, "
    "or try another detector (argument detector)"
)
"""The problem of an image in which there are none, which more knowledge of the lens may mend."""


def _thinned(lines: Iterable[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Points of each line in order, `_SPACING` px apart or more, to whole steps; three or more."""

    def thinned(line: np.ndarray) -> np.ndarray:
        length = float(np.hypot(*(line[-1] - line[0])))
        some = line[:: math.ceil(_SPACING * (len(line) - 1) / max(length, 1e-9))]
        return np.rint(some / STEP) * STEP

    return tuple(line for line in map(thinned, filter(len, lines)) if len(line) > 2)


def _finished(
    entries: "_Entries | None",
    source: Source,
    result: Future | Detection,
    detector: AbstractDetector,
    grid: str,
) -> Detection:
    try:
        detection = result if isinstance(result, Detection) else result.result()
    except LostError as error:
        return Detection(source.name, source.file, problem=str(error))
    if entries is not None and detection.problem in ("", NO_LINES):  # other problems may be mended
        of_image = None if detection.focal == source.focal else detection.focal
        _save(dataclasses.replace(detection, focal=of_image), entries.lines)
        if _wants_grid(grid, detector, detection.focal):
            none = np.zeros((0, 0, 2))
            _write(entries.grid, nodes=none if detection.nodes is None else detection.nodes)
    return detection


class _Entries(NamedTuple):
    """The files of the cache that hold what was found in an image.

    Two, as what is found in one way does not depend on what else was asked for.
    """

    lines: Path
    grid: Path

    @classmethod
    def of(cls, cache: Path, source: Source, detector: AbstractDetector) -> "_Entries":
        """By what the image shows, and the detectors."""
        try:
            shown = source.digest()
        except (OSError, ValueError) as error:  # reported when it is read
            shown = repr(error).encode()
        lines = "lines" if source.bend is None else f"lines {source.bend}"
        if source.path is not None and source.focal is not None:  # which its EXIF data come before
            lines += f" {source.focal}"
        ways = (lines, detector), ("grid", _grid_detector(detector))
        return cls(*(cache / f"{hashlib.sha256(_way(*way) + shown).hexdigest()}.npz" for way in ways))


def _way(what: str, detector: AbstractDetector) -> bytes:
    """What is searched for, and how: code, settings and version."""
    numbers = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(detector)]  # as repr leaves out arrays
    return _code(type(detector)) + f"{cv2.__version__} {what} {detector!r} {numbers}".encode()


@functools.cache
def _code(kind: type[AbstractDetector]) -> bytes:
    """Digest of the code by which this kind of detector works; empty if it is not in a file.

    Cached detections are invalid once it has changed.
    """
    folder = Path(__file__).parent
    files = [*sorted(folder.glob("*.py")), *sorted(folder.with_name("io").glob("*.py"))]
    try:
        defined = inspect.getsourcefile(kind)
        files.append(Path(defined or ""))
        return hashlib.sha256(b"".join(path.read_bytes() for path in files)).digest()
    except (OSError, TypeError):  # typed in
        return b""


def _save(detection: Detection, file: Path) -> None:
    lines = detection.lines
    _write(
        file,
        points=np.concatenate(lines) if lines else np.zeros((0, 2)),
        counts=np.array([len(line) for line in lines], int),
        image_size=np.array(detection.image_size),
        focal=np.array(np.nan if detection.focal is None else detection.focal),
        problem=np.array(detection.problem),
        unexplained=np.array(np.nan if detection.unexplained is None else detection.unexplained),
        bend=np.array(() if detection.bend is None else detection.bend, float),
    )


def _write(file: Path, **arrays: np.ndarray) -> None:
    content = io.BytesIO()
    np.savez(content, **arrays)  # pyright: ignore[reportArgumentType]
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(file) as part:
            part.write_bytes(content.getvalue())
    except OSError:  # a cache that cannot be written saves no time, and does no harm
        pass


def _known(
    entries: _Entries, source: Source, detector: AbstractDetector, grid: str
) -> tuple[Detection | None, bool]:
    """The cached detection, and whether a grid is still to be searched for."""
    known = _load(entries.lines, source)
    if known is None or not _wants_grid(grid, detector, known.focal):
        return known, False
    nodes = _load_nodes(entries.grid)
    return dataclasses.replace(
        known, nodes=nodes if nodes is not None and nodes.size else None
    ), nodes is None


def _load_nodes(file: Path) -> np.ndarray | None:
    """The cached nodes of a grid, empty if there was none; None if nobody has searched."""
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as stored:
            nodes = np.asarray(stored["nodes"], float)
    except Exception:  # a damaged entry: search again
        return None
    return nodes if nodes.ndim == 3 and nodes.shape[2] == 2 else None


def _load(file: Path, source: Source) -> Detection | None:
    """The cached detection, with the image's present name and no nodes; None if there is none."""
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as stored:
            points = np.asarray(stored["points"], float)
            counts, focal = stored["counts"].tolist(), float(stored["focal"])
            width, height = map(int, stored["image_size"].tolist())
            problem, unexplained = str(stored["problem"]), float(stored["unexplained"])
            k1, k2, x, y = stored["bend"].tolist() or [np.nan] * 4
        sound = (
            points.shape == (sum(counts), 2)
            and np.isfinite(points).all()
            and min(counts, default=1) > 0
            and min(width, height) >= _SMALLEST
            and (np.isnan(focal) or 0 < focal < np.inf)
        )
        if not sound:
            return None
    except Exception:  # a damaged entry: detect again
        return None
    return Detection(
        name=source.name,
        file=source.file,
        image_size=(width, height),
        lines=tuple(np.split(points, np.cumsum(counts)[:-1])) if counts else (),
        focal=source.focal if np.isnan(focal) else focal,
        problem=problem,
        unexplained=None if np.isnan(unexplained) else unexplained,
        bend=None if np.isnan(k1) else (k1, k2, x, y),
    )
