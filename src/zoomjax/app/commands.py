"""The commands: what each takes, and what it does with it.

Commands import what they need when they run, so that ``--help`` answers without waiting for JAX. They
compute in float64.
"""

import contextlib
import importlib.metadata
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .._core.files import cache_folder
from .._core.text import plain
from ._compiled import set_up_jax
from ._flags import with_flags
from .arguments import (
    Degree,
    Overwrite,
    Terms,
    board_of,
    number_of_cores,
    read_lines,
    refuse_image_options,
    refuse_to_replace,
    unit_of,
)
from .console import REPORT, progress_bar, show_calibration, show_images, stages, tell, tell_written

if TYPE_CHECKING:
    from ..lines.lines import Lines
    from .calibration import Calibration
    from .image_calibration import ImageCalibration, ImageJob

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="One continuous distortion model for a zoom lens, from images of straight things.",
)


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
    set_up_jax()
    from ..scenes.board import StripedBoard, nikkor_18_200
    from . import demo
    from .calibration import CLEARS, FILES
    from .image_calibration import ImageJob
    from .results_folder import results_folder

    board = StripedBoard.before(truth := nikkor_18_200(demo.IMAGE_SIZE))
    names = [*FILES, REPORT, "before-after.jpg", *(f"photos/{name}" for name in demo.photo_names(photos))]
    with results_folder(output, names, clears=[*CLEARS, "photos/*"], overwrite=overwrite) as folder:
        with progress_bar("Photographing the board") as progress:
            made = demo.write_photos(folder / "photos", number=photos, seed=seed, progress=progress)
        done = _calibrate_images(ImageJob(tuple(made), workers=number_of_cores()), folder)
        focal = sorted(done.focals.focal.values())
        lens = done.calibration.zoom.lens
        demo.write_before_after(made[0], folder / "before-after.jpg", lens, focal[0])
    show_calibration(done.calibration, board.magnification)
    show_images(done, output, also=["before-after.jpg", "photos/"])
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
    set_up_jax()
    from .calibration import CLEARS, FILES
    from .results_folder import results_folder

    if select and (degree, terms) != (2, 2):
        raise ValueError("--select chooses degree and terms: leave --degree and --terms out.")
    if any(path.lower().endswith((".npz", ".csv")) for path in inputs):
        refuse_image_options(
            {"--pitch": pitch, "--distance": distance, "--pixel": pixel, "--jobs": jobs}, inputs
        )
        for path in map(Path, inputs):
            if path.resolve() == (output / "lines.npz").resolve():
                raise ValueError(f"The results would replace the input {path}: give another folder.")
        results = results_folder(output, [*FILES, REPORT], clears=CLEARS, overwrite=overwrite)
        with results as folder, stages() as stage:
            stage("Reading the lines")
            lines = read_lines([Path(path) for path in inputs], focal, image_size, focal_unit)
            calibration = _calibrate(lines, degree, terms, focal_sigma, stage, folder, select, robust)
        show_calibration(calibration)
        if robust:
            rejected = int(calibration.rejected.sum())
            print(f"\n{rejected} lines are not straight in the scene and were rejected.")
        tell(calibration.warnings())
        tell_written(output)
        return
    if image_size is not None:
        raise ValueError("--image-size is for a CSV of lines: images have their own.")
    from .image_calibration import ImageJob

    job = ImageJob(
        tuple(inputs),
        detector=detector,
        focal=focal,
        focal_unit=unit_of(focal_unit),
        focal_sigma=focal_sigma,
        board=board_of(pitch, distance, pixel),
        degree=degree,
        terms=terms,
        select=select,
        frames=frames,
        workers=jobs or number_of_cores(),
        cache=cache_folder("detections") if cache else None,
    )
    refuse_to_replace(job, output)
    names = [*job.results(), REPORT]
    with results_folder(output, names, clears=CLEARS, overwrite=overwrite) as folder:
        done = _calibrate_images(job, folder)
    show_calibration(done.calibration)
    show_images(done, output)


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
    set_up_jax()
    from .undistort_files import Job, undistort_files

    with progress_bar("Correcting", timed=False) as progress:
        done = undistort_files(
            Job(lens, tuple(inputs), output, focal, keep, interpolation, border, hold, overwrite), progress
        )
    print(plain(done.sentence))
    for path, reason in done.skipped.items():
        print(plain(f"Skipped {path}: {with_flags(reason)}"), file=sys.stderr)
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
    set_up_jax()
    from rich.console import Console
    from rich.table import Table

    from . import reproduce as again
    from .results_folder import results_folder

    with results_folder(output, again.FILES, overwrite=overwrite) as folder, stages() as stage:
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
    calibration.make(folder, pages={REPORT: report(calibration)})
    return calibration


def _calibrate_images(job: "ImageJob", folder: Path) -> "ImageCalibration":
    from .image_calibration import calibrate_images
    from .report import report

    with contextlib.ExitStack() as shown:
        progress = shown.enter_context(progress_bar("Looking for lines"))

        def stage(name: str) -> None:
            nonlocal current
            if current is None:  # the bar makes way for the stages
                shown.close()
                current = shown.enter_context(stages())
            current(name)

        current: Callable[[str], None] | None = None
        done = calibrate_images(job, progress=progress, stage=stage)
        stage("Drawing the lines and writing the results")
        done.make(folder, pages={REPORT: report(done.calibration, done)})
    return done
