"""The commands and their options.

Commands import what they need when they run, so that ``--help`` does not wait for JAX. They compute in
float64.
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
    Centre,
    Degree,
    ModelName,
    Overwrite,
    Terms,
    board_of,
    centre_of,
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
    from .model_choice import WantedModel

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Calibrate the distortion of zoom lenses from images of straight lines, and correct images.",
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
    """Calibrate the distortion of zoom lenses from images of straight lines, and correct images."""


@app.command()
def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the results.", file_okay=False)
    ] = Path("zoomjax-demo"),
    photos: Annotated[
        int, typer.Option(min=3, help="Number of photos, each at its own focal length.")
    ] = 12,
    seed: Annotated[int, typer.Option(help="Random seed of the image noise.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Run a complete example: render photos of a board with a known lens, then calibrate from them.

    The scene is the first experiment of Alvarez et al. (2012): a board of
    31 x 23 stripes at 1185 mm, focal lengths from 20.56 to 127.36 mm, and the
    lens measured there, a Nikkor 18-200. The photos are calibrated as by
    zoomjax calibrate, and the result is compared with the true lens.
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
        with progress_bar("Rendering photos of the board") as progress:
            made = demo.write_photos(folder / "photos", number=photos, seed=seed, progress=progress)
        done = _calibrate_images(ImageJob(tuple(made), workers=number_of_cores()), folder)
        focal = sorted(done.focals.focal.values())
        lens = done.calibration.zoom.lens
        demo.write_before_after(made[0], folder / "before-after.jpg", lens, focal[0])
    show_calibration(done.calibration, board.magnification)
    show_images(done, output, also=["before-after.jpg", "photos/"])
    worst = demo.worst_error(lens, truth, focal)
    print(
        f"Largest error of the calibrated lens: {worst:.3f} px, over the whole image at all {len(focal)} "
        "focal lengths."
    )


@app.command()
def calibrate(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUT...",
            help="Photos, folders or patterns such as shots/*.jpg; or one video; or a file of lines: "
            "lines.npz, or a CSV file with the columns frame,line,x,y[,focal].",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the results.", file_okay=False)
    ],
    model: ModelName = None,
    degree: Degree = None,
    terms: Terms = None,
    centre: Centre = "fit",
    robust: Annotated[
        bool,
        typer.Option(
            "--robust",
            help="For a file of lines: reject lines that are not straight in the scene. For images this is "
            "always done.",
        ),
    ] = False,
    detector: Annotated[
        str,
        typer.Option(
            help="What to detect in images: edges (any straight edges), grid (checkerboards and dot grids) "
            "or pitch (markings of a sports pitch)."
        ),
    ] = "edges",
    focal: Annotated[
        str | None,
        typer.Option(
            help="Source of the focal lengths: a CSV file (columns image,focal; for a video time,focal or "
            "frame,focal; for CSV lines frame,focal), a number, exif, board (parallel to the sensor) or "
            "plane (oblique views of a flat grid). Default for photos: board if --pitch is given, else "
            "exif, else plane."
        ),
    ] = None,
    focal_unit: Annotated[
        str | None, typer.Option(help="Unit of focal lengths in a CSV file or number: mm (default) or px.")
    ] = None,
    focal_sigma: Annotated[
        str | None,
        typer.Option(
            help="Standard deviation of the focal lengths, in their unit or per cent, e.g. 0.3 or 1%. "
            "Standard deviations of the results include it. Default: the estimate of plane or board, the "
            "CSV column sigma, or else 0."
        ),
    ] = None,
    pitch: Annotated[
        str | None,
        typer.Option(
            metavar="MM[xMM]",
            help="For --focal board: distance between neighbouring lines of the board, across and down.",
        ),
    ] = None,
    distance: Annotated[
        float | None,
        typer.Option(metavar="MM", help="For --focal board: distance from the camera to the board."),
    ] = None,
    pixel: Annotated[
        float | None, typer.Option(metavar="MM", help="For --focal board: pixel size on the sensor.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="For a video: maximum number of frames used.")] = 60,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, help="Number of processes that detect lines; default: one per core."),
    ] = None,
    cache: Annotated[bool, typer.Option(help="Cache detections, and use cached ones.")] = True,
    image_size: Annotated[
        str | None, typer.Option(metavar="WxH", help="For CSV lines: image size in px, e.g. 1920x1080.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Calibrate a zoom lens from photos, a video or a file of lines.

    Writes lens.json, summary.json, report.html, model.png and lines.npz. From
    images it also writes lines/: each image with its detected lines. Results
    of an earlier run in the same folder are replaced.
    """
    set_up_jax()
    from .calibration import CLEARS, FILES
    from .model_choice import WantedModel
    from .results_folder import results_folder

    wanted = WantedModel(model or "auto", degree, terms)
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
            calibration = _calibrate(lines, wanted, centre_of(centre), focal_sigma, stage, folder, robust)
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
        model=wanted,
        centre=centre_of(centre),
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
    lens: Annotated[
        Path, typer.Argument(metavar="lens.json", help="The lens written by zoomjax calibrate.")
    ],
    inputs: Annotated[list[Path], typer.Argument(metavar="INPUT...", help="Photos, or one video.")],
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="OUT", help="Output file for a single input, else a folder."
        ),
    ],
    focal: Annotated[
        str | None,
        typer.Option(
            help="A focal length, or a CSV file: columns time,focal or frame,focal for a video, "
            "image,focal for photos. Default for photos: their EXIF data."
        ),
    ] = None,
    keep: Annotated[
        str,
        typer.Option(
            help="Framing of the corrected image: same (as the input), all (every input pixel) or valid "
            "(no empty borders). The framing stays constant while zooming."
        ),
    ] = "same",
    interpolation: Annotated[
        str, typer.Option(help="Interpolation: nearest, linear, cubic or lanczos.")
    ] = "linear",
    border: Annotated[
        str, typer.Option(help="Fill outside of the input image: constant (black), replicate or reflect.")
    ] = "constant",
    hold: Annotated[
        bool,
        typer.Option("--hold", help="Use the first and last focal length of a track beyond its ends."),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace existing files, but never an input.")
    ] = False,
) -> None:
    """Correct photos or a video, each image at its own focal length.

    Photos that cannot be corrected are reported and skipped. The exit status
    is then 1, or 2 if all were skipped.
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
    """Repeat the two experiments of Alvarez et al. (2012) on synthetic scenes.

    The paper's images are not public, so the scenes are made from its
    published numbers. Writes reproduce.md, with the tables next to those of
    the paper, Figures 5 to 10 as PNG and PDF, and reproduce.json.
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
        table = Table("", title=f"\n{title}: RMS residuals", title_justify="left", box=None)
        for column in ("the paper", "here", "difference"):
            table.add_column(column, justify="right", no_wrap=True)
        for row in experiment.rows:
            table.add_row(row.name, *row.cells())
        console.print(table, highlight=False)
    print(
        "\nAll scenes are synthetic. Tables, figures and the origin of each number are in "
        f"{plain(str(output / 'reproduce.md'))}."
    )


def _calibrate(
    lines: "Lines",
    model: "WantedModel",
    centre: "str | tuple[float, float]",
    focal_sigma: str | None,
    stage: Callable[[str], None],
    folder: Path,
    robust: bool,
) -> "Calibration":
    from .calibration import calibrate, focal_sigmas
    from .report import report

    sigma = focal_sigmas(focal_sigma or "0", lines.focal)
    calibration = calibrate(
        lines, model=model, centre=centre, focal_sigma=sigma, robust=robust, stage=stage
    )
    stage("Writing the results")
    calibration.make(folder, pages={REPORT: report(calibration)})
    return calibration


def _calibrate_images(job: "ImageJob", folder: Path) -> "ImageCalibration":
    from .image_calibration import calibrate_images
    from .report import report

    with contextlib.ExitStack() as shown:
        progress = shown.enter_context(progress_bar("Detecting lines"))

        def stage(name: str) -> None:
            nonlocal current
            if current is None:  # replace the bar by the stages
                shown.close()
                current = shown.enter_context(stages())
            current(name)

        current: Callable[[str], None] | None = None
        done = calibrate_images(job, progress=progress, stage=stage)
        stage("Drawing the lines and writing the results")
        done.make(folder, pages={REPORT: report(done.calibration, done)})
    return done
