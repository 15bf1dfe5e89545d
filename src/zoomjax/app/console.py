"""Terminal output of the commands: progress while they run, results when they are done."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .._core.text import plain
from ._interrupts import go_on

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from .calibration import Calibration
    from .image_calibration import ImageCalibration

REPORT = "report.html"


@contextlib.contextmanager
def progress_bar(what: str, timed: bool = True) -> Iterator[Callable[[int, int], None]]:
    """Yield a function of the number done and the total (0: unknown) that updates a bar on stderr.

    If `timed`, the elapsed time is printed at the end, as for a stage.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    start = time.perf_counter()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None, rate="")

        def show(done: int, total: int) -> None:
            go_on()
            speed = bar.tasks[0].speed
            rate = f"{speed:.1f} per s" if speed else ""
            bar.update(task, completed=done, total=total or None, rate=rate)

        yield show
    if timed:
        _stage_done(console, what, start)


def _stage_done(console: "Console", name: str, start: float) -> None:
    console.print(f"  [dim]{name:<40}{time.perf_counter() - start:7.2f} s[/dim]", highlight=False)


@contextlib.contextmanager
def stages() -> Iterator[Callable[[str], None]]:
    """Yield a function that starts a stage: it shows its name, and prints the previous stage's time."""
    from rich.console import Console

    console = Console(stderr=True)
    begun: list[tuple[str, float]] = []

    def finish() -> None:
        if begun:
            _stage_done(console, *begun.pop())

    with console.status("Starting") as status:

        def stage(name: str) -> None:
            go_on()
            finish()
            begun.append((name, time.perf_counter()))
            status.update(f"{name} …")

        yield stage
        go_on()
        finish()


def show_calibration(
    calibration: "Calibration", magnification: Callable[[float], float] | None = None
) -> None:
    """Print the table of RMS values, the polynomials and the displacement of a corner."""
    from rich.console import Console
    from rich.table import Table

    from .calibration import rms_over_frames

    console = Console()
    summary = calibration.summary()
    unit = summary["focal_unit"]
    low, high = summary["focal_range"]
    console.print(
        f"\n{summary['points']:,} points on {summary['lines']:,} lines in {summary['frames']} frames, "
        f"f = {low:g} to {high:g} {unit}\n",
        highlight=False,
    )
    table = Table(
        title="RMS distance of corrected points to straight lines", title_justify="left", box=None
    )
    table.add_column("", no_wrap=True)
    table.add_column("px", justify="right")
    if magnification:
        table.add_column("mm on the board", justify="right")
    table.add_column("vs. frame by frame", justify="right", no_wrap=True)
    table.add_column("px, held out", justify="right", no_wrap=True)
    held_out = {name: rms_over_frames(frames) for name, frames in calibration.held_out_rows().items()}
    for name, frames in calibration.rows():
        value = rms_over_frames(frames)
        cells = [name, f"{value:.4f}"]
        if magnification:
            scale = [magnification(float(f)) for f in calibration.lines.focal]
            cells.append(f"{rms_over_frames(frames / scale):.4f}")
        cells.append("" if name == "frame by frame" else _excess(value / summary["rms_frames"]))
        cells.append(f"{held_out[name]:.4f}" if held_out.get(name, math.nan) > 0 else "")
        table.add_row(*cells)
    console.print(table)
    console.print()
    if calibration.selection:
        print(calibration.selection, end="\n\n")
    polynomials = calibration.pixel_polynomials()
    for i, column in enumerate(polynomials.T, start=1):
        powers = ["", *(f" /f{'' if j == 1 else f'^{j}'}" for j in range(1, len(column)))]
        terms = " ".join(f"{value:+.4e}{power}" for value, power in zip(column, powers, strict=True))
        console.print(f"k{i}(f) = {terms}   px^-{2 * i}", highlight=False)
    if not polynomials.size:
        console.print(_coefficients(calibration))
    console.print(f"\n{calibration.centre.sentence}", highlight=False)
    corner = [f"{moved:+.2f} ± {std:.2g} px at {f:.4g} {unit}" for f, moved, std in calibration.corner()]
    console.print(f"\nThe correction moves a corner by {', '.join(corner)}.", highlight=False)
    if allowed_for := calibration.allowed_for():
        console.print(allowed_for, highlight=False)
    console.print(calibration.next.sentence, highlight=False)


def _coefficients(calibration: "Calibration") -> "Table":
    """A table of the coefficients at some focal lengths."""
    from rich.table import Table

    rows = calibration.coefficient_rows()
    table = Table(box=None)
    table.add_column(f"f, {calibration.zoom.lens.focal_unit}", justify="right")
    for i in range(1, len(rows[0])):
        table.add_column(f"k{i}, px^-{2 * i}", justify="right")
    for focal, *values in rows:
        table.add_row(f"{focal:.4g}", *(f"{value:+.4e}" for value in values))
    return table


def show_images(done: "ImageCalibration", folder: Path, also: Sequence[str] = ()) -> None:
    """Print how many lines were found and rejected, warnings, and where the results are."""
    found = sum(len(detection.lines) for detection in done.used)
    rejected = int(done.calibration.rejected.sum())
    print(
        f"\n{found} lines found in {len(done.used)} images; {rejected} of them are not straight in the "
        f"scene and were rejected.\nFocal lengths: {plain(done.focals.origin)}."
    )
    deviation = sorted(s / done.focals.focal[name] for name, s in done.focals.deviation.items())
    if deviation:
        print(f"Their standard deviations: {deviation[0]:.2%} to {deviation[-1]:.2%}.")
    tell(done.warnings())
    print(f"\nCheck the detected lines, drawn over each image, in {plain(str(folder / 'lines'))}.")
    tell_written(folder, ["lines/", *also])


def tell(warnings: Sequence[str]) -> None:
    """Print warnings on stderr."""
    from rich.console import Console
    from rich.text import Text

    for warning in warnings:  # names in it may look like markup
        Console(stderr=True).print(Text.assemble("\n", ("Warning:", "bold"), " ", warning))


def tell_written(folder: Path, also: Sequence[str] = ()) -> None:
    """Print where the results are."""
    files = [REPORT, "lens.json", "lines.npz", "summary.json", "model.png", *also]
    print(f"\nWritten to {plain(str(folder))}: {', '.join(files)}")


def _excess(ratio: float) -> str:
    return f"{100 * (ratio - 1):+.2f} %" if ratio < 2 else f"{ratio:.1f} times"
