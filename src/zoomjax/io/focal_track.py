"""Focal lengths over time, ``time,focal`` or ``frame,focal``, interpolated in 1/f.

Between two samples 1/f is taken as linear, because that is the variable in which the distortion is smooth.
"""

import dataclasses
import os
import warnings

import numpy as np

from .._core.arguments import check_flag, kinds_checked
from .._core.checks import real_numbers
from .text_table import read_text_table


@dataclasses.dataclass(frozen=True)
class FocalTrack:
    """A focal length for every time from the first sample to the last.

    Attributes:
        position: positions of the samples, increasing: seconds from the start, or frame numbers from 0.
        focal: focal length at each position, positive.
        by_time: whether positions are seconds.
        hold: whether the first and last focal lengths are used beyond the ends.

    Example:
        >>> FocalTrack(np.array([0.0, 10.0]), np.array([20.0, 60.0]), by_time=False).at(5, 0.2)
        30.0
    """

    position: np.ndarray
    focal: np.ndarray
    by_time: bool = True
    hold: bool = False

    def __post_init__(self):
        """Check the samples, which may be lists, and that the rest are truth values: any word would be."""
        for name in ("by_time", "hold"):
            check_flag(name, getattr(self, name))
        for name in ("position", "focal"):
            if (values := real_numbers(getattr(self, name))) is None:
                raise ValueError(f"Argument {name} must hold numbers, but it is {getattr(self, name)!r}.")
            object.__setattr__(self, name, values.astype(np.float64))
        if self.position.ndim != 1 or self.position.shape != self.focal.shape or not self.position.size:
            raise ValueError(
                "Arguments position and focal must hold one number a sample, at least one, but their "
                f"shapes are {self.position.shape} and {self.focal.shape}."
            )
        good = np.isfinite(self.focal) & (self.focal >= np.finfo(np.float64).tiny)  # and so is 1/f
        if not good.all():
            bad = int(np.argmin(good))
            raise ValueError(
                f"Argument focal must hold positive numbers, but sample {bad} is {self.focal[bad]}."
            )
        if not np.isfinite(self.position).all() or (np.diff(self.position) <= 0).any():
            raise ValueError(
                "Argument position must increase from sample to sample, but it does not. Sort the track, "
                "and give each moment once."
            )

    def at(self, frame: int, time: float) -> float:
        """The focal length of a frame, given its number from 0 and its time in seconds.

        Raises:
            ValueError: the frame is outside of the track and `hold` is False; or the frame has no time
                (NaN) and the track is in seconds, and not of one focal length that is held.
        """
        position = time if self.by_time else float(frame)
        if self.hold and len(self.position) == 1:
            position = float(self.position[0])
        if not np.isfinite(position):
            raise ValueError(
                "The frames of the video have no times, and the focal track is in seconds. Give a track of "
                "frame numbers, frame,focal."
            )
        first, last = float(self.position[0]), float(self.position[-1])
        slack = 1e-3 if self.by_time else 0.0  # times are printed with milliseconds
        if not self.hold and not first - slack <= position <= last + slack:
            unit = "s" if self.by_time else "frames"
            raise ValueError(
                f"The focal track goes from {first:g} to {last:g} {unit}, and frame {frame}, at "
                f"{time:.3f} s, is outside of it. Give a track as long as the video, or hold its ends "
                "(argument hold)."
            )
        return 1 / float(np.interp(position, self.position, 1 / self.focal))

    def warn_if_longer(self, frame: int, time: float, *, stacklevel: int = 2) -> None:
        """Warn if this is hardly the track of a video with this last frame, as it goes on after it.

        A track of one focal length is right for any video. Tracks in seconds may be a little longer.
        """
        last, end = float(self.position[-1]), time if self.by_time else float(frame)
        slack = max(_LONGER * end, 1.0) if self.by_time else 0.0
        if last > end + slack and np.ptp(self.focal) > 0:
            unit = "s" if self.by_time else "frames"
            base = "Times are in seconds" if self.by_time else "Frames count from 0"
            warnings.warn(
                f"The focal track goes on to {last:g} {unit}, and the video ends at {end:g}: is it the "
                f"track of this video? {base}.",
                stacklevel=stacklevel + 1,
            )


@kinds_checked
def read_focal_track(path: str | os.PathLike[str], *, hold: bool = False) -> FocalTrack:
    """Read a track from a CSV file with a header, ``time,focal`` (seconds) or ``frame,focal`` (from 0).

    With the header ``time_or_frame`` positions are frames if all are whole numbers, else seconds. For the
    format see `zoomjax.io.text_table`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not such a track, or not in order of time; the message names it.

    Warns:
        UserWarning: samples follow each other closely, but some are missing while the lens zooms.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "track.csv"
        >>> _ = path.write_text("time,focal\\n0,20\\n10,60\\n")
        >>> read_focal_track(path).at(125, 5.0)
        30.0
    """
    table = read_text_table(path, "a focal track", numbers=("focal",), one_of=tuple(_BY_TIME))
    [header] = table.numbers.keys() & _BY_TIME.keys()
    position, focal = table.numbers[header], table.numbers["focal"]
    by_time, whole = _BY_TIME[header], position == np.floor(position)
    if by_time is False:
        table.check("frame", whole, "a whole number (seconds are in a column time)")
    if by_time is None:
        by_time = not whole.all()
    table.check("focal", focal >= np.finfo(np.float64).tiny, "a positive number")
    later = np.append(True, np.diff(position) > 0)
    table.check(header, later, "greater than in the row before: sort the track, and give each moment once")
    track = FocalTrack(position, focal, by_time=by_time, hold=hold)
    _warn_of_gap(track, path)
    return track


_RECORD, _EVEN = 20, 0.9
"""Samples, and the share of even steps, from which a track is a record and not a few keys."""

_GAP, _ZOOMED = 10, 0.02
"""Steps that are missing, and the change of log f across them, from which it is said."""


def _warn_of_gap(track: FocalTrack, path: str | os.PathLike[str]) -> None:
    """Warn of a record with a gap, across which f is another: how the lens zoomed there is not known.

    A track of few samples, or of uneven ones, is one of keys between which f is meant to be interpolated.
    """
    step = np.diff(track.position)
    if len(step) < _RECORD or np.mean(step < 1.5 * np.median(step)) < _EVEN:
        return
    change = np.abs(np.diff(np.log(track.focal)))
    gaps = np.flatnonzero((step > _GAP * np.median(step)) & (change > _ZOOMED))
    if len(gaps):
        at = int(gaps[np.argmax(change[gaps])])
        unit = "s" if track.by_time else "frames"
        more = {1: "", 2: ", and one other gap"}.get(len(gaps), f", and {len(gaps) - 1} other gaps")
        warnings.warn(
            f"{os.fspath(path)} has no samples from {track.position[at]:g} to {track.position[at + 1]:g} "
            f"{unit}, while the focal length goes from {track.focal[at]:.4g} to {track.focal[at + 1]:.4g}"
            f"{more}: it is interpolated there. Add rows if the lens did not zoom steadily.",
            stacklevel=3,
        )


_LONGER = 0.05
"""Of a video's length, by which a track in seconds may be longer."""

_BY_TIME = {"time": True, "frame": False, "time_or_frame": None}
"""Columns of positions: whether they are seconds."""
