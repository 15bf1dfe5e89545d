"""Terminal output of the commands: progress while they run, results when they are done."""

import contextlib
import math
import textwrap
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .._core.text import percentages, plain, with_std
from ._interrupts import go_on

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from ..trust.assessment import Finding
    from ..trust.selection import Selection
    from .calibration import Calibration
    from .image_calibration import ImageCalibration

REPORT = "report.html"

_MOST_NOTABLE = 8
"""Photos whose verdict is not good that are listed."""

_TICK = 10.0
"""Seconds between signs of life where there is no terminal."""


@contextlib.contextmanager
def progress_bar(
    what: str, timed: bool = True, *, quiet: bool = False
) -> Iterator[Callable[[int, int], None]]:
    """Yield a function of the number done and the total (0: unknown) that updates a bar on stderr.

    If `timed`, the elapsed time is printed at the end, as for a stage. Where there is no terminal, a line
    is printed every ten seconds. If `quiet`, nothing is printed.
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
    start = told = time.perf_counter()
    with Progress(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    ) as bar:
        task = bar.add_task(what, total=None, rate="")

        def show(done: int, total: int) -> None:
            nonlocal told
            go_on()
            if not (quiet or console.is_terminal) and time.perf_counter() - told > _TICK:
                told = time.perf_counter()
                _stage_done(console, f"{what}: {done} of {total or 'unknown'}", start)
            speed = bar.tasks[0].speed
            rate = f"{speed:.1f} per s" if speed else ""
            bar.update(task, completed=done, total=total or None, rate=rate)

        yield show
    if timed and not quiet:
        _stage_done(console, what, start)


def _stage_done(console: "Console", name: str, start: float) -> None:
    console.print(f"  [dim]{name:<40}{time.perf_counter() - start:7.2f} s[/dim]", highlight=False)


def _going_on(console: "Console", name: str, start: float) -> None:
    console.print(f"  [dim]… {name}, for {time.perf_counter() - start:.0f} s so far[/dim]", highlight=False)


@contextlib.contextmanager
def stages(*, quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """Yield a function that starts a stage: it shows its name, and prints the previous stage's time.

    Where there is no terminal, a line says every ten seconds what goes on, and since when. If `quiet`,
    nothing is printed.
    """
    from rich.console import Console

    console = Console(stderr=True, quiet=quiet)
    begun: list[tuple[str, float]] = []

    def finish() -> None:
        if begun:
            _stage_done(console, *begun.pop())

    with contextlib.ExitStack() as shown:
        status = shown.enter_context(console.status("Starting"))
        if not console.is_terminal:
            shown.enter_context(_ticking(lambda: [_going_on(console, *last) for last in begun[-1:]]))

        def stage(name: str) -> None:
            go_on()
            finish()
            begun.append((name, time.perf_counter()))
            status.update(f"{name} …")

        yield stage
        go_on()
        finish()


@contextlib.contextmanager
def _ticking(tell: Callable[[], object]) -> Iterator[None]:
    """Call a function every ten seconds."""
    over = threading.Event()

    def tick() -> None:
        while not over.wait(_TICK):
            tell()

    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def show_verdict(calibration: "Calibration") -> None:
    """Print the verdict, and for each finding what to do."""
    found = calibration.assessment
    print_verdict(found.verdict, found.sentence, found.findings)


def print_verdict(verdict: str, sentence: str, findings: "Sequence[Finding]") -> None:
    """Print the sentence of a verdict, and for each finding what to do."""
    from rich.console import Console
    from rich.text import Text

    console, (word, _, reason) = Console(), sentence.partition(":")
    colour = {"good": "green", "doubtful": "yellow"}.get(verdict, "red")
    console.print(Text.assemble((f"{word}:", f"bold {colour}"), reason))
    for place, finding in enumerate(findings):
        known = place == 0 and verdict != "good"  # from the line above
        console.print(Text(f"  - {'' if known else _capital(finding.found) + ' '}{finding.advice}"))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def show_calibration(
    calibration: "Calibration", magnification: Callable[[float], float] | None = None
) -> None:
    """Print the verdict, the table of RMS values, the polynomials and the displacement of a corner."""
    from rich.console import Console
    from rich.table import Table

    from .calibration import rms_over_frames

    console = Console()
    summary = calibration.summary()
    unit = summary["focal_unit"]
    show_verdict(calibration)
    out = f", {summary['rejected_lines']} left out," * (summary["rejected_lines"] > 0)
    console.print(
        f"\n{summary['points']:,} points on {summary['lines']:,} lines{out} in "
        f"{summary['frames']} frame{'s' * (summary['frames'] > 1)}, "
        f"{calibration.focal_text()}\n",
        highlight=False,
    )
    title = f"RMS distance of points to lines, in the {summary['distances']}"
    console.print(title, style="italic", highlight=False)  # a table would break it to its own width
    table = Table(box=None)
    table.add_column("", no_wrap=True)
    table.add_column("px, held out", justify="right", no_wrap=True)
    table.add_column("px", justify="right")
    if magnification:
        table.add_column("mm on board", justify="right")
    held_out = {name: rms_over_frames(frames) for name, frames in calibration.held_out_rows().items()}
    for name, frames in calibration.rows():
        value = rms_over_frames(frames)
        left_out = held_out.get(name, math.nan)
        cells = [name, f"{left_out:.4f}" if left_out > 0 else "", f"{value:.4f}"]
        if magnification:
            scale = [magnification(float(f)) for f in calibration.lines.focal]
            cells.append(f"{rms_over_frames(frames / scale):.4f}")
        table.add_row(*cells)
    show_table(table)
    console.print(" ".join(filter(None, (calibration.held_out, calibration.weighting))), highlight=False)
    console.print()
    if calibration.selection:
        show_choice(calibration.selection)
    if summary["distortion_model"] != "RadialPolynomial":
        console.print(f"Distortion model: {summary['distortion_model']}", highlight=False)
    polynomials = calibration.pixel_polynomials()
    for (name, order), column in zip(calibration.coefficient_names().items(), polynomials.T, strict=False):
        powers = ["", *(f" /f{'' if j == 1 else f'^{j}'}" for j in range(1, len(column)))]
        terms = " ".join(f"{value:+.4e}{power}" for value, power in zip(column, powers, strict=True))
        console.print(f"{name}(f) = {terms}   px^-{order}", highlight=False)
    if not polynomials.size:
        show_table(_coefficients(calibration))
    console.print(f"\n{calibration.centre.sentence}", highlight=False)
    corner = [
        with_std(moved, std, "px") + f" at {f:.4g} {unit}" * calibration.focal_known
        for f, moved, std in calibration.corner
    ]
    console.print(f"\nThe correction moves a corner by {', '.join(corner)}.", highlight=False)
    if allowed_for := calibration.allowed_for():
        console.print(allowed_for, highlight=False)
    console.print(calibration.advice(), highlight=False)


def show_table(table: "Table", *, highlight: bool = True) -> None:
    """Print a table for a terminal of a usual width at least: rows of a narrower one lost figures."""
    from rich.console import Console

    Console(width=max(Console().width, _USUAL)).print(table, highlight=highlight)


_USUAL = 80


def show_choice(selection: "Selection") -> None:
    """Print what the models that were compared leave of lines left out, the chosen one marked by ">"."""
    from rich.table import Table

    table = Table(title=selection.title, title_justify="left", box=None, pad_edge=False)
    table.add_column("")
    for name in ("parameters", "px, held out", "to the best"):
        table.add_column(name, justify="right", no_wrap=True)
    for of, row in zip(selection.compared, selection.rows(), strict=True):
        mark = ">" if of.candidate is selection.chosen else " "
        if of.problem:
            table.add_row(f"{mark} {row[0]}", "", "not compared", "")
            continue
        best = f"{of.difference:+.4f} ± {of.difference_std:.4f}"
        table.add_row(
            f"{mark} {row[0]}", row[1], row[3], "best" if of.candidate is selection.best else best
        )
    show_table(table)
    if selection.why:
        say(selection.why)
    print()


def show_frames(calibration: "Calibration", names: Sequence[str] = ()) -> None:
    """Print each frame's focal length, straightness and lines, from the shortest f; and the versions."""
    from rich.console import Console
    from rich.table import Table

    console, summary = Console(), calibration.summary()
    table = Table(title="Frames: RMS distance to straight lines, px", title_justify="left", box=None)
    table.add_column("", overflow="fold")
    for name in (
        f"f, {summary['focal_unit']}",
        "before",
        "after",
        "left out",
        "alone",
        "lines",
        "rejected",
    ):
        table.add_column(name, justify="right", no_wrap=True)
    rejected = Counter(row["frame"] for row in summary["rejected"])
    shown = dict(enumerate(names))
    for row in sorted(summary["per_frame"], key=lambda row: row["focal"]):
        values = (row[key] for key in ("rms_none", "rms_zoom", "rms_held_out", "rms_frames"))
        figures = ("–" if value is None else f"{value:.3f}" for value in values)
        frame = row["frame"]
        table.add_row(
            plain(shown.get(frame, str(frame))),
            f"{row['focal']:.5g}",
            *figures,
            str(row["lines"]),
            str(rejected[frame]),
        )
    console.print()
    show_table(table)
    versions = ", ".join(f"{name} {of}" for name, of in summary["versions"].items())
    console.print(f"\nVersions: {versions}", highlight=False)


def _coefficients(calibration: "Calibration") -> "Table":
    """A table of the coefficients at some focal lengths."""
    from rich.table import Table

    rows = calibration.coefficient_rows()
    table = Table(box=None)
    table.add_column(f"f, {calibration.fit.lens.focal_unit}", justify="right")
    for name, order in calibration.coefficient_names().items():
        table.add_column(f"{name}, px^-{order}", justify="right")
    for focal, *values in rows:
        table.add_row(f"{focal:.4g}", *(f"{value:+.4e}" for value in values))
    return table


def show_images(done: "ImageCalibration", folder: Path, also: Sequence[str] = ()) -> None:
    """Print how many lines were found and rejected, warnings, and where the results are."""
    found = sum(len(detection.lines) for detection in done.used)
    rejected = int(done.calibration.rejected.sum())
    print()
    lost = "none" if not rejected else f"{rejected} of them {'is' if rejected == 1 else 'are'}"
    say(f"{found} lines found in {_images(len(done.used))}; {lost} rejected as not straight in the scene.")
    say(f"Focal lengths: {plain(done.focals.origin)}.")
    deviation = sorted(s / done.focals.focal[name] for name, s in done.focals.deviation.items())
    if deviation:
        say(f"Their standard deviations: {percentages(deviation)}.")
    if prior := done.prior():
        say(prior)
    for sentence in [*done.shared(), *done.board()]:
        say(sentence)
    notable = [
        f"{plain(d.name)}: {verdict}, {reason}."
        for d, (verdict, reason) in zip(done.used, done.verdicts(), strict=True)
        if verdict != "good" and len(done.used) > 1  # of one photo the verdict is above
    ]
    for sentence in notable[:_MOST_NOTABLE]:
        say(sentence)
    if len(notable) > _MOST_NOTABLE:
        say(f"{len(notable) - _MOST_NOTABLE} more photos that are not good are listed in summary.json.")
    tell(done.warnings())
    if drawn := sum(map(bool, done.overlays())):
        over = "each image" if drawn == len(done.used) else f"{drawn} of {len(done.used)} images"
        print()
        say(f"Check the detected lines, drawn over {over}, in {plain(str(folder / 'lines'))}.")
    tell_written(folder, [*["lines/"] * bool(drawn), *also])


def say(text: str) -> None:
    """Print text in lines as wide as the terminal, in which words stay whole, as paths must."""
    from rich.console import Console

    print(textwrap.fill(text, Console().width, break_long_words=False, break_on_hyphens=False))


def _images(number: int) -> str:
    return f"{number} image{'s' * (number > 1)}"


def tell(warnings: Sequence[str]) -> None:
    """Print warnings on stderr."""
    from rich.console import Console
    from rich.text import Text

    for warning in warnings:  # names in it may look like markup
        Console(stderr=True).print(Text.assemble("\n", ("Warning:", "bold"), " ", warning))


def tell_written(folder: Path, also: Sequence[str] = ()) -> None:
    """Print where the results are."""
    files = [REPORT, "lens.json", "lines.npz", "summary.json", "model.png", *also]
    print()
    say(f"Written to {plain(str(folder))}: {', '.join(files)}")
