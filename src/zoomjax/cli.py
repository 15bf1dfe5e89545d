"""The command line: ``zoomjax demo``, ``calibrate``, ``undistort`` and ``reproduce``.

Commands import what they need when they run, so that ``--help`` answers without waiting for JAX. They
compute in float64. Errors go to stderr with exit status 2, and leave no partial result.
"""

import contextlib
import glob
import importlib.metadata
import io
import logging
import math
import os
import re
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

try:
    import typer
except ModuleNotFoundError:
    sys.exit('The command line needs the extra "app": pip install "zoomjax[app]"')

from ._files import cache_folder, is_unfinished
from ._text import plain

if TYPE_CHECKING:
    from rich.console import Console

    from .calibration import Calibration
    from .lines import Lines
    from .vision.focals import Board
    from .vision.image_calibration import ImageCalibration, ImageJob

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="One continuous distortion model for a zoom lens, from images of straight things.",
)

Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Replace files of these names, too, that zoomjax did not write or that were changed since.",
    ),
]
Degree = Annotated[int, typer.Option(min=0, help="Degree of the polynomials in 1/f.")]
Terms = Annotated[int, typer.Option(min=1, help="Number of distortion coefficients, k1 to kN.")]


_MOST_COMPILED = 100_000_000  # bytes; a run with new shapes adds about a million
_REPORT = "report.html"
_INTERRUPTED = 128 + signal.SIGINT  # Typer's exit status for Ctrl-C, too
_LAST_WORDS: dict[int, str] = {
    _INTERRUPTED: "Interrupted.",
    128 + signal.SIGTERM: "Ended by a signal.",
}


def main() -> None:
    """Run the command line; what a user can mend is one sentence on stderr and exit status 2."""
    warnings.showwarning = _print_warning
    sys.unraisablehook = _swallowed
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal that cannot show a sign ends no run
    signal.signal(signal.SIGTERM, _end)  # and leave no half file
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else a shell had it ignored
        signal.signal(signal.SIGINT, _end)
    try:
        app()
    except (ValueError, OSError, RuntimeError, MemoryError) as error:
        print(f"Error: {_sentence(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:  # where Typer does not see it
        _leave(_INTERRUPTED)
    except SystemExit as exit:
        if isinstance(exit.code, int) and exit.code in _LAST_WORDS:
            _leave(exit.code)
        raise


_signals: list[int] = []


def _end(number: int, _: object) -> NoReturn:
    _signals.append(number)
    if not is_unfinished():  # an exception in the midst of importing JAX can abort the process
        _leave(128 + number)
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    sys.exit(128 + number)


def _swallowed(unraisable: "sys.UnraisableHookArgs") -> None:
    if not isinstance(unraisable.exc_value, KeyboardInterrupt | SystemExit):  # those are for `_go_on`
        sys.__unraisablehook__(unraisable)


def _go_on() -> None:
    """Between two steps: end after all if what `_end` raised was swallowed, as in callbacks of JAX."""
    if _signals:
        _end(_signals[0], None)


def _leave(status: int) -> NoReturn:
    """At once: the usual way out waits for a compiler thread, and can crash in it."""
    with contextlib.suppress(OSError):
        os.write(2, f"{_LAST_WORDS[status]}\n".encode())  # a handler may be within print
    os._exit(status)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"zoomjax {importlib.metadata.version('zoomjax')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """One continuous distortion model for a zoom lens, from images of straight things."""


@app.command()
def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the results.", file_okay=False)
    ] = Path("zoomjax-demo"),
    photos: Annotated[int, typer.Option(min=3, help="Number of photographs, one a focal length.")] = 12,
    seed: Annotated[int, typer.Option(help="Seed of the photographs' noise.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """The paper's first experiment: photograph its board through a known lens, then calibrate the photos.

    A board of 31 x 23 stripes at 1185 mm, at focal lengths from 20.56 to 127.36 mm, through the lens that
    the paper measured, a Nikkor 18-200. The photographs are rendered; what then runs on them is
    zoomjax calibrate.
    """
    _set_up_jax()
    from . import synthetic
    from ._results import results_folder
    from .calibration import CLEARS, FILES
    from .vision import demo
    from .vision.image_calibration import ImageJob

    board = synthetic.StripedBoard.before(truth := synthetic.nikkor_18_200(demo.IMAGE_SIZE))
    names = [*FILES, _REPORT, "before-after.jpg", *(f"photos/{name}" for name in demo.photo_names(photos))]
    with results_folder(output, names, clears=[*CLEARS, "photos/*"], overwrite=overwrite) as folder:
        with _progress("Photographing the board") as progress:
            made = demo.write_photos(folder / "photos", number=photos, seed=seed, progress=progress)
        done = _calibrate_images(ImageJob(tuple(made), workers=_cores()), folder)
        focal = sorted(done.focals.focal.values())
        lens = done.calibration.zoom.lens
        demo.write_before_after(made[0], folder / "before-after.jpg", lens, focal[0])
    _show(done.calibration, board.magnification)
    _show_images(done, output, also=["before-after.jpg", "photos/"])
    worst = demo.worst_error(lens, truth, focal)
    print(f"The lens is within {worst:.3f} px of the true one, everywhere in all {len(focal)} images.")


@app.command()
def calibrate(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUT...",
            help="Photos, folders of them or patterns; or a video; or lines: lines.npz, or a CSV "
            "frame,line,x,y[,focal].",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.", file_okay=False)
    ],
    degree: Degree = 2,
    terms: Terms = 2,
    select: Annotated[
        bool, typer.Option("--select", help="Choose degree and terms: see what lines left out prefer.")
    ] = False,
    robust: Annotated[
        bool,
        typer.Option(
            "--robust", help="Reject lines that are not straight in the scene, as is done in photos."
        ),
    ] = False,
    detector: Annotated[
        str, typer.Option(help="What to look for in images: edges, grid or pitch.")
    ] = "edges",
    focal: Annotated[
        str | None,
        typer.Option(
            help="Where focal lengths come from: a CSV (image,focal; of a video time,focal or frame,focal; "
            "of CSV lines frame,focal), a number, exif, board or plane. Without it: the best there is."
        ),
    ] = None,
    focal_unit: Annotated[
        str | None, typer.Option(help="Unit of the focal lengths of a CSV or a number: mm (default) or px.")
    ] = None,
    focal_sigma: Annotated[
        str | None,
        typer.Option(
            help="Standard deviation of the focal lengths, in their unit or per cent, e.g. 0.3 or 1%: what "
            "the bands allow for. Without it: what plane, board or a CSV column sigma tell, or none."
        ),
    ] = None,
    pitch: Annotated[
        str | None,
        typer.Option(
            metavar="MM[xMM]", help="--focal board: from one line on it to the next, across and down."
        ),
    ] = None,
    distance: Annotated[
        float | None, typer.Option(metavar="MM", help="--focal board: from the camera to the board.")
    ] = None,
    pixel: Annotated[
        float | None, typer.Option(metavar="MM", help="--focal board: side of a pixel on the sensor.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="Of a video: how many frames, at most.")] = 60,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes that look at images; by default one a core.")
    ] = None,
    cache: Annotated[bool, typer.Option(help="Remember what was found in images.")] = True,
    image_size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Image size of a CSV of lines, px, e.g. 1920x1080.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Calibrate a zoom lens from images of straight things, or from lines.

    Writes lens.json, summary.json, report.html, model.png and lines.npz; and lines/, what was found in
    each image. Its own results of an earlier run in the same folder are replaced.
    """
    _set_up_jax()
    from ._results import results_folder
    from .calibration import CLEARS, FILES

    if select and (degree, terms) != (2, 2):
        raise ValueError("--select chooses degree and terms: leave --degree and --terms out.")
    if any(path.lower().endswith((".npz", ".csv")) for path in inputs):
        _refuse_image_options(
            {"--pitch": pitch, "--distance": distance, "--pixel": pixel, "--jobs": jobs}, inputs
        )
        for path in map(Path, inputs):
            if path.resolve() == (output / "lines.npz").resolve():
                raise ValueError(f"The results would replace the input {path}: give another folder.")
        results = results_folder(output, [*FILES, _REPORT], clears=CLEARS, overwrite=overwrite)
        with results as folder, _stages() as stage:
            stage("Reading the lines")
            lines = _read([Path(path) for path in inputs], focal, image_size, focal_unit)
            calibration = _calibrate(lines, degree, terms, focal_sigma, stage, folder, select, robust)
        _show(calibration)
        if robust:
            rejected = int(calibration.rejected.sum())
            print(f"\n{rejected} lines are not straight in the scene and were rejected.")
        _tell(calibration.warnings())
        _written(output)
        return
    if image_size is not None:
        raise ValueError("--image-size is for a CSV of lines: images have their own.")
    from .vision.image_calibration import ImageJob

    job = ImageJob(
        tuple(inputs),
        detector=detector,
        focal=focal,
        focal_unit=_unit(focal_unit),
        focal_sigma=focal_sigma,
        board=_board(pitch, distance, pixel),
        degree=degree,
        terms=terms,
        select=select,
        frames=frames,
        workers=jobs or _cores(),
        cache=cache_folder("detections") if cache else None,
    )
    _refuse_to_replace(job, output)
    names = [*job.results(), _REPORT]
    with results_folder(output, names, clears=CLEARS, overwrite=overwrite) as folder:
        done = _calibrate_images(job, folder)
    _show(done.calibration)
    _show_images(done, output)


@app.command()
def undistort(
    lens: Annotated[Path, typer.Argument(metavar="lens.json", help="The lens, from zoomjax calibrate.")],
    inputs: Annotated[list[Path], typer.Argument(metavar="INPUT...", help="Photos, or one video.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT", help="A file for one input, else a folder.")
    ],
    focal: Annotated[
        str | None,
        typer.Option(
            help="A focal length, or a CSV: time,focal or frame,focal of a video, image,focal of photos. "
            "Without it, photos' EXIF data tell."
        ),
    ] = None,
    keep: Annotated[
        str, typer.Option(help="What to show: same, all or valid; one framing for all of a zoom.")
    ] = "same",
    interpolation: Annotated[str, typer.Option(help="nearest, linear, cubic or lanczos.")] = "linear",
    border: Annotated[
        str, typer.Option(help="What lies beyond the image: constant (black), replicate or reflect.")
    ] = "constant",
    hold: Annotated[
        bool, typer.Option("--hold", help="Hold the first and last focal length beyond a track's ends.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace files that are there, but never an input.")
    ] = False,
) -> None:
    """Correct photos, or a video, each at its own focal length.

    Photos that cannot be corrected are named and skipped; the exit status is then 1, or 2 if none is left.
    """
    _set_up_jax()
    from .vision.files import Job, undistort_files

    with _progress("Correcting", timed=False) as progress:
        done = undistort_files(
            Job(lens, tuple(inputs), output, focal, keep, interpolation, border, hold, overwrite), progress
        )
    print(plain(done.sentence))
    for path, reason in done.skipped.items():
        print(plain(f"Skipped {path}: {reason}"), file=sys.stderr)
    if done.skipped:
        raise typer.Exit(2 if len(done.skipped) == len(inputs) else 1)


@app.command()
def reproduce(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.", file_okay=False)
    ],
    overwrite: Overwrite = False,
) -> None:
    """The paper's two experiments done again, its tables and figures beside ours.

    The scenes are made from what the paper published, as its images are not public. Writes reproduce.md
    with the tables, Figures 5 to 10 as PNG and PDF, and reproduce.json.
    """
    _set_up_jax()
    from rich.console import Console
    from rich.table import Table

    from . import reproduce as again
    from ._results import results_folder

    with results_folder(output, again.FILES, overwrite=overwrite) as folder, _stages() as stage:
        experiments = again.reproduce(folder, stage)
    console = Console()
    for title, experiment in zip(("Table 1, striped board", "Table 2, football"), experiments, strict=True):
        table = Table("", title=f"\n{title}: RMS residues", title_justify="left", box=None)
        for column in ("the paper", "here", "difference"):
            table.add_column(column, justify="right", no_wrap=True)
        for row in experiment.rows:
            table.add_row(row.name, *row.cells())
        console.print(table, highlight=False)
    print(
        f"\nAll scenes are synthetic: what is whose is in {plain(str(output / 'reproduce.md'))}, "
        "with the figures."
    )


@contextlib.contextmanager
def _progress(what: str, timed: bool = True) -> Iterator[Callable[[int, int], None]]:
    """A function of what is done and of how much (0: unknown), shown as a bar on stderr.

    If `timed`, the bar leaves behind how long it took, as a stage does.
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
            _go_on()
            speed = bar.tasks[0].speed
            rate = f"{speed:.1f} per s" if speed else ""
            bar.update(task, completed=done, total=total or None, rate=rate)

        yield show
    if timed:
        _stage_done(console, what, start)


def _stage_done(console: "Console", name: str, start: float) -> None:
    console.print(f"  [dim]{name:<40}{time.perf_counter() - start:7.2f} s[/dim]", highlight=False)


def _set_up_jax() -> None:
    """Compute in float64, and keep what is compiled for the next run: most of a short run is compiling.

    What cannot be kept, or read again, is compiled anew: a loss of time, of which nobody need hear.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    folder = cache_folder("compiled")
    if folder and "JAX_COMPILATION_CACHE_DIR" not in os.environ and _can_write(folder):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_compilation_cache_max_size", _MOST_COMPILED)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    logging.getLogger("matplotlib").setLevel(
        logging.ERROR
    )  # else it tells of fonts and of folders of its own


def _can_write(folder: Path) -> bool:
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    return folder.is_dir() and os.access(folder, os.W_OK)


def _read(inputs: list[Path], focal: str | None, image_size: str | None, focal_unit: str | None) -> "Lines":
    if len(inputs) > 1:
        raise ValueError(f"Give one file of lines; there are {len(inputs)}.")
    [path] = inputs
    if path.suffix == ".npz":
        if (focal, image_size, focal_unit) != (None, None, None):
            raise ValueError(
                f"{path} carries its own focal lengths and image size: --focal, --image-size and "
                "--focal-unit are for CSV files."
            )
        from .lines import load_lines

        return load_lines(path)
    if path.suffix == ".csv":
        from .io.lines_csv import read_focal_csv, read_lines_csv

        if image_size is None:
            raise ValueError(f"The image size of {path} is not known: give --image-size, e.g. 1920x1080.")
        width, _, height = image_size.lower().partition("x")
        if not (width.isdigit() and height.isdigit()):
            raise ValueError(f"--image-size must be like 1920x1080, but it is {image_size!r}.")
        return read_lines_csv(
            path,
            image_size=(int(width), int(height)),
            focal=None if focal is None else read_focal_csv(Path(focal)),
            focal_unit=focal_unit or "mm",
        )
    raise ValueError(f"Cannot calibrate from {path}: give lines.npz, or a CSV file frame,line,x,y[,focal].")


def _calibrate(
    lines: "Lines",
    degree: int,
    terms: int,
    focal_sigma: str | None,
    stage: Callable[[str], None],
    folder: Path,
    select: bool,
    robust: bool,
) -> "Calibration":
    from .calibration import calibrate, focal_sigmas
    from .report import report

    sigma = focal_sigmas(focal_sigma or "0", lines.focal)
    calibration = calibrate(
        lines, degree=degree, terms=terms, focal_sigma=sigma, select=select, robust=robust, stage=stage
    )
    stage("Writing the results")
    calibration.make(folder, pages={_REPORT: report(calibration)})
    return calibration


def _calibrate_images(job: "ImageJob", folder: Path) -> "ImageCalibration":
    from .report import report
    from .vision.image_calibration import calibrate_images

    with contextlib.ExitStack() as shown:
        progress = shown.enter_context(_progress("Looking for lines"))

        def stage(name: str) -> None:
            nonlocal current
            if current is None:  # the bar makes way for the stages
                shown.close()
                current = shown.enter_context(_stages())
            current(name)

        current: Callable[[str], None] | None = None
        done = calibrate_images(job, progress=progress, stage=stage)
        stage("Drawing the lines and writing the results")
        done.make(folder, pages={_REPORT: report(done.calibration, done)})
    return done


def _cores() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _unit(given: str | None) -> str:
    if given not in (None, "mm", "px"):
        raise ValueError(f"--focal-unit must be mm or px, but it is {given!r}.")
    return given or "mm"


def _board(pitch: str | None, distance: float | None, pixel: float | None) -> "Board | None":
    from .vision.focals import Board

    if pitch is distance is pixel is None:
        return None
    pitches = [_positive(part) for part in (pitch or "").lower().split("x")]
    given = {"--pitch": all(pitches), "--distance": (distance or 0) > 0, "--pixel": (pixel or 0) > 0}
    bad = [name for name, good in given.items() if not good]
    if bad or len(pitches) > 2 or distance is None or pixel is None:
        raise ValueError(
            "A board needs its --pitch (MM, or MMxMM across and down), its --distance and the sensor's "
            f"--pixel, all in mm and positive: {' and '.join(bad or ['--pitch'])} is not."
        )
    return Board((pitches[0], pitches[-1]), distance, pixel)


def _positive(text: str) -> float:
    """The number, or 0 if it is none or not positive."""
    from .io.text_table import plain_number

    return max(plain_number(text) or 0.0, 0.0)


def _refuse_to_replace(job: "ImageJob", output: Path) -> None:
    """Refuse to write over photographs that are calibrated from."""
    from .vision.images import RESULTS

    results = {(output / name).resolve() for name in RESULTS}
    for source in job.sources()[0] if job.video is None else ():
        real = (source.path or Path()).resolve()
        if results.intersection((real, *real.parents)):
            raise ValueError(
                f"The results would replace the photograph {source.path}: give another folder."
            )


def _refuse_image_options(options: dict[str, object], inputs: list[str]) -> None:
    given = [name for name, value in options.items() if value is not None]
    if given:
        raise ValueError(f"{' and '.join(given)} are for images, but {inputs[0]} holds lines.")


@contextlib.contextmanager
def _stages() -> Iterator[Callable[[str], None]]:
    """A function that shows what is being done, and how long what was done before took."""
    from rich.console import Console

    console = Console(stderr=True)
    begun: list[tuple[str, float]] = []

    def finish() -> None:
        if begun:
            _stage_done(console, *begun.pop())

    with console.status("Starting") as status:

        def stage(name: str) -> None:
            _go_on()
            finish()
            begun.append((name, time.perf_counter()))
            status.update(f"{name} …")

        yield stage
        _go_on()
        finish()


def _show(calibration: "Calibration", magnification: Callable[[float], float] | None = None) -> None:
    """Print the table and the polynomials."""
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
    table = Table(title="Distance of corrected points to their lines, RMS", title_justify="left", box=None)
    table.add_column("", no_wrap=True)
    table.add_column("px", justify="right")
    if magnification:
        table.add_column("mm on the board", justify="right")
    table.add_column("over frame by frame", justify="right", no_wrap=True)
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
    for i, column in enumerate(calibration.pixel_polynomials().T, start=1):
        powers = ["", *(f" /f{'' if j == 1 else f'^{j}'}" for j in range(1, len(column)))]
        terms = " ".join(f"{value:+.4e}{power}" for value, power in zip(column, powers, strict=True))
        console.print(f"k{i}(f) = {terms}   px^-{2 * i}", highlight=False)
    corner = [f"{moved:+.2f} ± {std:.2g} px at {f:.4g} {unit}" for f, moved, std in calibration.corner()]
    console.print(f"\nCorrected, a corner moves by {', '.join(corner)}.", highlight=False)
    if allowed_for := calibration.allowed_for():
        console.print(allowed_for, highlight=False)
    console.print(calibration.next.sentence, highlight=False)


def _show_images(done: "ImageCalibration", folder: Path, also: Sequence[str] = ()) -> None:
    """Print what became of the images and their lines, and where the results are."""
    found = sum(len(detection.lines) for detection in done.used)
    rejected = int(done.calibration.rejected.sum())
    print(
        f"\nLines found in {len(done.used)} images: {found}, of which {rejected} are not straight in the "
        f"scene and were rejected.\nFocal lengths: {plain(done.focals.origin)}."
    )
    deviation = sorted(s / done.focals.focal[name] for name, s in done.focals.deviation.items())
    if deviation:
        print(f"Their standard deviations: {deviation[0]:.2%} to {deviation[-1]:.2%}.")
    _tell(done.warnings())
    print(
        f"\nLook at {plain(str(folder / 'lines'))} before you believe: the lines found, drawn over each "
        "image."
    )
    _written(folder, ["lines/", *also])


def _tell(warnings: Sequence[str]) -> None:
    from rich.console import Console
    from rich.text import Text

    for warning in warnings:  # names in it may look like markup
        Console(stderr=True).print(Text.assemble("\n", ("Beware:", "bold"), " ", warning))


def _written(folder: Path, also: Sequence[str] = ()) -> None:
    files = [_REPORT, "lens.json", "lines.npz", "summary.json", "model.png", *also]
    print(f"\nWritten to {plain(str(folder))}: {', '.join(files)}")


def _excess(ratio: float) -> str:
    return f"{100 * (ratio - 1):+.2f} %" if ratio < 2 else f"{ratio:.1f} times"


def _sentence(error: BaseException) -> str:
    """What an error says, without Python's numbers for those of the operating system."""
    text = str(error)
    if isinstance(error, MemoryError):
        text = f"There is not enough memory. {text}".strip()
    elif isinstance(error, OSError) and error.strerror:
        text = error.strerror + (f": {os.fspath(error.filename)}" if error.filename is not None else ".")
    return plain(text).replace("give overwrite.", "give --overwrite.")


def _print_warning(message, category, filename, lineno, file=None, line=None) -> None:
    unkept = _UNKEPT.match(str(message))
    if unkept and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        _forget_compiled(unkept[1])
        return
    print(f"Warning: {plain(str(message))}", file=sys.stderr)


_UNKEPT = re.compile(r"Error (?:reading|writing) persistent compilation cache entry for '([^']*)'")


def _forget_compiled(name: str) -> None:
    """Remove what was kept of a program: JAX would never replace what a full disk has cut off."""
    folder = cache_folder("compiled")
    for path in folder.glob(f"{glob.escape(name)}-*") if folder else ():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                path.unlink()
