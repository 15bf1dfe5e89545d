"""Correction of files: what ``zoomjax undistort`` does. Arguments are checked before any work."""

import dataclasses
import functools
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING

from .._core.files import refuse_existing, refuse_inputs, refuse_links
from .._core.text import plain, reason
from ..correct.framing import Framing, check_keep
from ..correct.photo import Correction, corrected_before, photo_focal
from ..correct.sampler import check_sampling
from ..io.focal_table import read_focal_table
from ..io.metadata import geometry_of, work_of
from ..io.photo import read_metadata
from ..models.about import UNKNOWN
from ..models.lens import ZoomLens, load_lens
from ._photos import BAD_FILE, SAME, CommonFraming, corrected_photos, foreseen
from .equipment import taken_at_others, taken_otherwise
from .plans import files_plan
from .relative import warn_of_relative
from .undistort_inputs import Found, find_inputs, focal_number, targets_of, told_of_earlier

if TYPE_CHECKING:
    from ..correct.video import CorrectedVideo


@dataclasses.dataclass(frozen=True)
class Job:
    """Settings of a correction.

    Attributes:
        lens: file of the lens; None if it is found for each photo (`library_lens`).
        inputs: photos or videos, folders or patterns.
        output: file for a single input, else a folder.
        focal: a number, a CSV file, a folder of these for videos, or None for the photos' EXIF data.
        keep, interpolation, border: as for `undistort_image`; one framing for all photos.
        hold: whether a track's first and last focal lengths are used beyond its ends.
        overwrite: whether existing files may be replaced; inputs never are.
        redistort: whether corrected files are given, and distortion is applied.
        again: whether photos that are corrected already are corrected again.
        resume: whether what an earlier run has written is left as it is.
        dry_run: whether only to say what would be written.
    """

    lens: Path | None
    inputs: tuple[Path, ...]
    output: Path
    focal: str | None = None
    keep: str = "same"
    interpolation: str = "linear"
    border: str = "constant"
    hold: bool = False
    overwrite: bool = False
    redistort: bool = False
    again: bool = False
    resume: bool = False
    dry_run: bool = False


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of a correction.

    Attributes:
        sentence: a sentence on what was written; on a line of its own for each lens of the library.
        skipped: for each file that was not corrected, by path, the reason.
        written: the number of files that are corrected, now or earlier.
        notes: sentences on what was kept, what was not, and what was left out.
        files: sources and the files that are made of them, now or earlier.
    """

    sentence: str
    skipped: dict[str, str] = dataclasses.field(default_factory=dict)
    written: int = 0
    notes: tuple[str, ...] = ()
    files: tuple[tuple[Path, Path], ...] = ()


Progress = Callable[[int, int], None]


def undistort_files(
    job: Job, progress: Progress = lambda done, total: None, executor: Executor | None = None
) -> Outcome:
    """Correct photos or videos. Of several files, those that cannot be corrected are skipped.

    Args:
        job: the settings.
        progress: called after each photo, or after frames of a video.
        executor: where photos, or segments of a video, are corrected; None: here. Its workers read and
            write photos by the same paths.

    Raises:
        OSError, ValueError: the options, the lens, the table of focal lengths or the targets are wrong,
            checked before any work; or the errors of `undistort_video` or `undistort_photo` for a single
            file. If a target cannot be written, the files before it are complete.
    """
    check_sampling(job.interpolation, job.border)
    check_keep(job.keep)
    if job.lens is None:
        raise ValueError("Argument lens must be the file of a lens.")
    warn_of_relative(lens := load_lens(job.lens), job.focal)
    found = photos_or_videos(job)
    work = functools.partial(_videos, dict(found.videos)) if found.videos else undistort_photos
    files = found.videos or found.photos
    targets = targets_of(files, job.output, job.inputs)
    done = work(job, lens, [path for path, _ in files], targets, progress, executor)
    return with_refused(done, found, targets)


def photos_or_videos(job: Job) -> Found:
    """The photos or the videos that are given.

    Raises:
        FileNotFoundError, ValueError: as `find_inputs`; or there are both, or neither.
    """
    found = find_inputs(job.inputs, job.output)
    if found.photos and found.videos:
        raise ValueError("Give photos or videos, not both.")
    if not found.photos and not found.videos:
        path, reason = next(iter(found.refused.items()))
        raise ValueError(f"Cannot correct {path}: {reason}.")
    return found


def with_refused(done: Outcome, found: Found, targets: Sequence[Path]) -> Outcome:
    """An outcome, with what was left out beforehand, and what is there in place of missing results."""
    sources = [path for path, _ in (*found.photos, *found.videos)]
    skipped = {str(path): why for path, why in found.refused.items()}
    skipped |= told_of_earlier(done.skipped, sources, targets)
    return dataclasses.replace(done, skipped=skipped, notes=(*found.notes, *done.notes))


def _videos(
    names: Mapping[Path, Path],
    job: Job,
    lens: ZoomLens,
    sources: Sequence[Path],
    targets: Sequence[Path],
    progress: Progress,
    executor: Executor | None,
) -> Outcome:
    from .undistort_videos import tracks_of, undistort_videos

    if job.again:
        raise ValueError(
            "Argument again is for photos, which say that they are corrected, and the inputs are videos: "
            "leave it out."
        )
    unknown = job.focal is None and lens.about.get("focal") == UNKNOWN
    tracks = tracks_of(str(float(lens.focal_range[0])) if unknown else job.focal, names, hold=job.hold)
    todo = to_do(job, sources, targets, lambda _, target: _is_video(target))
    if job.dry_run:
        return _planned(todo, len(sources) - len(todo), lambda _: "")
    correct = functools.partial(
        undistort_videos,
        lens=lens,
        keep=job.keep,
        interpolation=job.interpolation,
        border=job.border,
        back=job.redistort,
        executor=executor,
    )
    done, skipped = correct(
        [(source, target, tracks[source]) for source, target in todo], progress=progress
    )
    if len(sources) == 1 and skipped:
        raise next(iter(skipped.values()))
    earlier = len(sources) - len(todo)
    frames, written = sum(video.frames for video in done.values()), len(done)
    if len(sources) == 1 and done:
        [(target, video)] = done.items()
        sentence = f"{frames} frames {_done(job)}, scale {video.scale:.4f}: {target}"
    else:
        sentence = f"{_counted(written, len(sources), earlier, job, 'video')}, {frames} frames"
    notes = [note for target, video in done.items() for note in _kept(target, video, len(sources))]
    notes += _unmarked([path for path in targets if path not in {target for _, target in todo}])
    bad = {str(path): reason(error) for path, error in skipped.items()}
    files = _made(sources, targets, skipped)
    return Outcome(sentence, bad, written + earlier, tuple(notes), files)


def _made(
    sources: Sequence[Path], targets: Sequence[Path], skipped: Mapping[Path, Exception]
) -> tuple[tuple[Path, Path], ...]:
    pairs = zip(sources, targets, strict=True)
    return tuple((source, target) for source, target in pairs if source not in skipped)


def _planned(todo: Sequence[tuple[Path, Path]], earlier: int, about: Callable[[Path], str]) -> Outcome:
    """What would be written, with what is known about each source."""
    told, skipped = [], {}
    for source, target in todo:
        try:
            told.append(plain(f"  {source} -> {target}{about(source)}"))
        except BAD_FILE as error:
            skipped[source] = error
    files = tuple((source, target) for source, target in todo if source not in skipped)
    bad = {str(source): reason(error) for source, error in skipped.items()}
    return Outcome(files_plan(told, earlier), bad, files=files)


def _kept(target: Path, video: "CorrectedVideo", number: int) -> list[str]:
    """What of a video was kept and what was not, each in a sentence."""
    of = f" of {target.name}" if number > 1 else ""
    sentences = ((f"Kept{of}", video.kept), (f"Not kept{of}", video.not_kept))
    return [f"{begins}: {', '.join(names)}." for begins, names in sentences if names]


def undistort_photos(
    job: Job,
    lens: ZoomLens,
    sources: Sequence[Path],
    targets: Sequence[Path],
    progress: Progress,
    executor: Executor | None = None,
) -> Outcome:
    """Correct photos by one lens, whatever the job's own; it raises as `undistort_files`."""
    if job.hold:
        raise ValueError(
            "Argument hold is for a video's track of focal lengths, and the inputs are photos."
        )
    correction = Correction(lens, SAME, job.interpolation, job.border, job.redistort, job.again)
    focal_of = _photo_focals(job, lens, sources)
    skipped: dict[Path, Exception] = {}
    keep, shown = _common_keep(job, lens, sources, focal_of, skipped)
    correction = dataclasses.replace(correction, keep=keep, shown=shown)
    todo = to_do(job, sources, targets, functools.partial(_is_result, job, correction, focal_of))
    if job.dry_run:
        about = functools.partial(foreseen, correction, focal_of)
        return _planned(todo, len(sources) - len(todo), about)
    lost: Counter[tuple[str, str]] = Counter()
    wanted = [pair for pair in todo if pair[0] not in skipped]
    known = None if job.focal is None and executor is not None else focal_of
    done = corrected_photos(wanted, correction, known, executor)
    for number, (source, target, missing) in enumerate(done, start=1):
        if isinstance(missing, Exception):
            skipped[source] = missing
        else:
            lost.update((target.suffix.lower(), name) for name in missing)
        progress(len(todo) - len(wanted) + number, len(todo))
    if len(sources) == 1 and skipped:
        raise next(iter(skipped.values()))
    earlier = len(sources) - len(todo)
    bad = {str(source): reason(skipped[source]) for source, _ in todo if source in skipped}
    written = len(todo) - len(bad)
    unmarked = [
        path for path in targets if path not in {target for _, target in todo} and _holds_none(path)
    ]
    given = [source for source, _ in wanted]
    corrected = [source for source in given if source not in skipped]
    before = () if job.redistort else (*corrected_before(given), *taken_otherwise(lens, corrected))
    before += () if job.focal is None else tuple(taken_at_others(lens, corrected, focal_of))
    notes = (*_losses(lost), *_unmarked(unmarked), *before)
    sentence = _counted(written, len(sources), earlier, job, "photo")
    files = _made(sources, targets, skipped)
    return Outcome(sentence, bad, written + earlier, notes, files)


def _counted(written: int, number: int, earlier: int, job: Job, what: str) -> str:
    count = (
        f"{number} {what}{'s' * (number > 1)}" if written == number else f"{written} of {number} {what}s"
    )
    before = f" now, {earlier} earlier" if earlier else ""
    return f"{count} {_done(job)}{before}: {job.output}"


def _done(job: Job) -> str:
    return "redistorted" if job.redistort else "corrected"


def _losses(lost: Counter[tuple[str, str]]) -> tuple[str, ...]:
    """What could not be kept, each once."""
    return tuple(
        f"Not kept in {number} {suffix} file{'s' * (number > 1)}: {name}."
        for (suffix, name), number in sorted(lost.items())
    )


def _unmarked(left: Sequence[Path]) -> list[str]:
    """That files were left of which nobody can tell what they are results of."""
    if not left:
        return []
    more = f" and {len(left) - 1} more" if len(left) > 1 else ""
    return [
        f"Left as before: {left[0]}{more}. Such files hold no mark of the work that made them: if another "
        "lens, focal length or option made them, remove them first."
    ]


def _is_result(
    job: Job, correction: Correction, focal_of: Callable[[Path], float], source: Path, target: Path
) -> bool:
    """Whether a photo is what the same work makes of a source; any is, of a format that holds no mark.

    Raises:
        FileExistsError: it was made by other work, and must not be replaced.
    """
    try:
        metadata = read_metadata(target)
        if _holds_none(target):
            return True
        if geometry_of(metadata) != correction.geometry:
            return False
        if work_of(metadata) == correction.work(source, focal_of(source)):
            return True
    except BAD_FILE:
        return False
    if job.overwrite:
        return False
    raise FileExistsError(
        f"{target} was not made from {source} with this lens, focal length and options, or by an earlier "
        "version: give another output, or argument overwrite to make it again."
    )


def _holds_none(path: Path) -> bool:
    return path.suffix.lower() == ".bmp"


def _is_video(path: Path) -> bool:
    """Whether a file may be the result of an earlier run."""
    from ..io.video_reader import opened_video

    try:
        with opened_video(path):
            return True
    except BAD_FILE:
        return False


def to_do(
    job: Job,
    sources: Sequence[Path],
    targets: Sequence[Path],
    is_result: Callable[[Path, Path], bool] = lambda source, target: False,
) -> list[tuple[Path, Path]]:
    """Sources and targets that are to be done: with `resume`, those without a result.

    Raises:
        FileExistsError, ValueError: a target exists, or is an input.
    """
    tables = [] if job.focal is None else [job.focal]
    lens = [] if job.lens is None else [job.lens]
    refuse_inputs(targets, [*sources, *lens, *tables])
    refuse_links(job.output, targets)
    pairs = list(zip(sources, targets, strict=True))
    if job.resume:
        pairs = [pair for pair in pairs if not (os.path.lexists(pair[1]) and is_result(*pair))]
    refuse_existing([target for _, target in pairs], overwrite=job.overwrite)
    return pairs


def _common_keep(
    job: Job,
    lens: ZoomLens,
    sources: Sequence[Path],
    focal_of: Callable[[Path], float],
    skipped: dict[Path, Exception],
) -> tuple[Callable[[tuple[int, int]], str | Framing], str]:
    """The framing for each image size, common to all focal lengths of the photos; what it depends on.

    Photos without a focal length are added to `skipped`.
    """
    if job.keep == "same":
        return SAME, job.keep
    focals = []
    for source in sources:
        try:
            focals.append(focal_of(source))
        except BAD_FILE as error:
            skipped[source] = error
    if not focals:
        return SAME, job.keep
    low, high = min(focals), max(focals)
    keep = CommonFraming(lens, job.keep, low, high, job.redistort)
    return keep, f"{job.keep} from {low!r} to {high!r}"


def _photo_focals(job: Job, lens: ZoomLens, sources: Sequence[Path]) -> Callable[[Path], float]:
    """A function giving a photo's focal length: from the table, the number or its EXIF data.

    Raises:
        OSError, ValueError: the table is missing or wrong, or one row of it is for two photos.
    """
    if job.focal is None:
        return functools.cache(lambda path: photo_focal(path, lens))
    number = focal_number(job.focal)
    if number is not None:
        return lambda path: number
    table = read_focal_table(job.focal)
    table.of(map(str, sources))  # which refuses a row for two photos
    return table.need
