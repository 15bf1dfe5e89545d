"""The commands and their options.

Commands import what they need when they run: ``--help`` does not wait for JAX. They compute in float64.
"""

import dataclasses
import importlib.metadata
from pathlib import Path
from typing import Annotated

import typer

from .._core.files import cache_folder, refuse_inputs
from .._core.forked import import_ahead
from ._jax import set_up_jax
from .arguments import (
    Centre,
    Degree,
    DistortionModel,
    KnownFocal,
    ModelName,
    Overwrite,
    Terms,
    at_hand,
    board_of,
    centre_of,
    number_of_cores,
    read_lines,
    refits,
    refuse_to_replace,
    split_lens,
    unit_of,
    with_lines_of_results,
)
from .clips import ClipJob, calibrate_clip, refuse_idle_for_clips, wants_motion
from .console import REPORT, progress_bar, show_calibration, show_images, stages
from .options import (
    CALIBRATE_EXAMPLES,
    FIT,
    IDLE_FOR_LINES,
    INPUT,
    UNDISTORT_EXAMPLES,
    Again,
    AsJson,
    Border,
    Cluster,
    ClusterToCorrect,
    Detector,
    Distance,
    DryRun,
    Exclude,
    FileOrFolder,
    Focal,
    FocalAtUse,
    FocalSigma,
    FocalUnits,
    Frames,
    Hold,
    Interpolation,
    JsonOfWork,
    Keep,
    OtherLens,
    Overlays,
    PixelPitch,
    Quiet,
    QuietWork,
    Redistort,
    Replace,
    ResultsFolder,
    Resume,
    SharedFocal,
    Spacing,
    Strict,
    Verbose,
    WithLines,
    detector_for,
    excluded,
    refuse_auto,
    refuse_idle,
    refuse_idle_sources,
)
from .plans import check_centre, images_plan, lines_plan, photo_sizes, tell_plan, without
from .runs import calibrate_images, calibrate_lines, title_of
from .shown import Shown, show_outcome

DETECTION = "zoomjax.detect.batch"
"""What processes that detect lines import."""

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
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


@app.command(epilog="Example: `zoomjax demo -o demo`")
def demo(
    output: ResultsFolder = Path("zoomjax-demo"),
    photos: Annotated[
        int, typer.Option(min=3, metavar="N", help="Number of photos, each at its own focal length.")
    ] = 12,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Random seed of the image noise.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Run a complete example: render photos of a board with a known lens, then calibrate from them.

    The scene is the first experiment of Alvarez et al. (2012): a board of
    31 x 23 stripes at 1185 mm, focal lengths from 20.56 to 127.36 mm, and the
    lens measured there, a Nikkor 18-200. The photos are calibrated as by
    zoomjax calibrate, and the result is compared with the true lens.
    """
    import_ahead(DETECTION)
    set_up_jax()
    from ..scenes.board import StripedBoard, nikkor_18_200
    from . import demo
    from .calibration import FILES
    from .image_job import ImageJob
    from .results_folder import OF_A_LENS, results_folder

    board = StripedBoard.before(truth := nikkor_18_200(demo.IMAGE_SIZE))
    names = [*FILES, REPORT, "before-after.jpg", *(f"photos/{name}" for name in demo.photo_names(photos))]
    with results_folder(output, names, clears=[*OF_A_LENS, "photos/*"], overwrite=overwrite) as folder:
        with progress_bar("Rendering photos of the board") as progress:
            made = demo.write_photos(folder / "photos", number=photos, seed=seed, progress=progress)
        job = ImageJob(tuple(made), workers=number_of_cores())
        done = calibrate_images(job, folder, title="The paper's board")
        focal = sorted(done.focals.focal.values())
        lens = done.calibration.fit.lens
        demo.write_before_after(made[0], folder / "before-after.jpg", lens, focal[0])
    show_calibration(done.calibration, board.magnification)
    show_images(done, output, also=["before-after.jpg", "photos/"])
    worst = demo.worst_error(lens, truth, focal)
    print(
        f"Largest error of the calibrated lens: {worst:.3f} px, over the whole image at all {len(focal)} "
        "focal lengths."
    )


@app.command(epilog=CALIBRATE_EXAMPLES)
def calibrate(
    context: typer.Context,
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUT...",
            help="Photos, folders or patterns such as shots/*.jpg, or URLs; or one video; or files "
            "of lines: lines.npz, or CSV files with the columns frame,line,x,y[,focal]; or a folder of "
            "results, whose lines are fitted again.",
        ),
    ],
    output: ResultsFolder,
    model: ModelName = None,
    degree: Degree = None,
    terms: Terms = None,
    distortion_model: DistortionModel = None,
    centre: Centre = None,
    robust: Annotated[
        bool,
        typer.Option(
            "--robust",
            help="For a file of lines: reject lines that are not straight in the scene. For images this is "
            "always done.",
            rich_help_panel=FIT,
        ),
    ] = False,
    detector: Annotated[
        Detector,
        typer.Option(
            help="What to detect in images: edges (any straight edges), grid (checkerboards, ChArUco "
            "boards, dot grids) or pitch (markings of a sports pitch).",
            rich_help_panel=INPUT,
        ),
    ] = "edges",
    focal: Focal = None,
    focal_unit: FocalUnits = None,
    focal_sigma: FocalSigma = None,
    shared_focal: SharedFocal = None,
    known_focal: KnownFocal = None,
    spacing: Spacing = None,
    distance: Distance = None,
    pixel_pitch: PixelPitch = None,
    with_lines: WithLines = False,
    frames: Frames = 60,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Number of processes that detect lines; default: one per core.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    cluster: Cluster = None,
    cache: Annotated[
        bool, typer.Option(help="Cache detections, and use cached ones.", rich_help_panel=INPUT)
    ] = True,
    image_size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", help="For CSV lines: image size in px, e.g. 1920x1080.", rich_help_panel=INPUT
        ),
    ] = None,
    exclude: Exclude = None,
    overlays: Overlays = "some",
    strict: Strict = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
    dry_run: DryRun = False,
    overwrite: Overwrite = False,
) -> None:
    """Calibrate a zoom lens from photos, a video or a file of lines.

    Writes lens.json, summary.json, report.html, model.png and lines.npz. From
    images it also writes lines/: each image with its detected lines. From a
    video without focal lengths it writes track.csv, the focal length of each
    frame, tracks.npz, motion.png and panorama.jpg; with --lines also lines.npz
    and lines/. Results of an earlier run in the same folder are replaced or
    removed; its lines.npz, tracks.npz and track.csv stay until they are
    written again.
    """
    inputs = with_lines_of_results(at_hand(context, inputs, quiet=quiet), meant=bool(exclude) or robust)
    of_lines = [path for path in inputs if path.lower().endswith((".npz", ".csv"))]
    if not (of_lines or dry_run or cluster):
        import_ahead(DETECTION)
    set_up_jax()
    show = Shown(strict, quiet, as_json, verbose)
    from .model_choice import WantedModel

    refuse_auto(model, degree)
    wanted = WantedModel("auto" if model is None else model, degree, terms, distortion_model)
    about = wanted.usual_centre if centre is None else centre_of(centre)
    wanted.check_centre(about)
    if focal == "same":
        refuse_idle(context, ("focal_sigma",), "with --focal same, for f is not known")
    if of_lines:
        refuse_idle(context, IDLE_FOR_LINES, f"for {of_lines[0]}, which contains lines")
        from .calibration import FILES
        from .results_folder import OF_A_LENS, results_folder

        files = [Path(path) for path in inputs]
        out = excluded(exclude, files)
        names = [name for name in FILES if not refits(files, output / name)]
        refuse_inputs([output / name for name in names], inputs)
        results = results_folder(output, [*names, REPORT], clears=OF_A_LENS, overwrite=overwrite)
        if dry_run:
            lines = read_lines(files, focal, image_size, focal_unit, focal_sigma)
            check_centre(about, [lines.image_size])
            plan = lines_plan(lines, out, focal_known=focal != "same")
            return tell_plan(plan, output, as_json=as_json)
        with results as folder, stages(quiet=quiet) as stage:
            stage("Reading the lines")
            lines = without(read_lines(files, focal, image_size, focal_unit, focal_sigma), out)
            calibration = calibrate_lines(
                lines,
                folder,
                stage,
                model=wanted,
                centre=about,
                focal_sigma=focal_sigma,
                robust=robust,
                files=files,
                names=names,
                focal_known=focal != "same",
            )
        return show.lines(calibration, output, robust=robust)
    if image_size is not None:
        raise ValueError("--image-size is for a CSV of lines: images have their own.")
    if exclude:
        raise ValueError("--exclude is for a file of lines: give the lines.npz of the calibration.")
    from .image_job import ImageJob
    from .results_folder import OF_A_LENS, results_folder

    if wants_motion(inputs, focal, spacing):
        refuse_idle_for_clips(context)
        clip = ClipJob(
            inputs,
            output,
            wanted,
            about,
            known=tuple(known_focal or ()),
            focal_unit=focal_unit,
            focal_sigma=focal_sigma,
            pixel_pitch=pixel_pitch,
            lines=with_lines,
            detector=detector,
            frames=frames,
            workers=jobs or number_of_cores(),
            cache=cache_folder("detections") if cache else None,
            overlays=overlays,
            overwrite=overwrite,
            by_default=focal is None and not known_focal,
        )
        return calibrate_clip(clip, show, dry_run=dry_run)
    refuse_idle(context, ("with_lines",), "without --focal motion: all else is calibrated from lines")
    refuse_idle(context, ("known_focal",), "without --focal motion")
    refuse_idle_sources(context, focal)
    job = ImageJob(
        tuple(inputs),
        detector=detector_for(context, detector, focal),
        focal=focal,
        focal_unit=unit_of(focal_unit),
        focal_sigma=focal_sigma,
        board=board_of(spacing, distance, pixel_pitch),
        shared_focal=shared_focal,
        model=wanted,
        centre=about,
        frames=frames,
        workers=jobs or number_of_cores(),
        cache=cache_folder("detections") if cache else None,
        overlays=overlays,
    )
    if job.video is None:
        refuse_idle(context, ("frames",), "for photos")
    if cluster is not None:
        refuse_idle(context, ("jobs",), "with --cluster, whose workers detect lines")
    refuse_to_replace(job, output)
    if dry_run:
        check_centre(about, photo_sizes(job))
        return tell_plan(images_plan(job), output, as_json=as_json)
    names = [*job.results(), REPORT]
    from .undetermined import Undetermined

    try:
        with results_folder(output, names, clears=OF_A_LENS, overwrite=overwrite) as folder:
            done = calibrate_images(job, folder, title=title_of(inputs), quiet=quiet, cluster=cluster)
    except Undetermined as error:
        raise ValueError(f"{error} {error.keep(output, overwrite=overwrite)}") from error
    return show.images(done, output)


@app.command(epilog=UNDISTORT_EXAMPLES)
def undistort(
    context: typer.Context,
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="[lens.json] INPUT...",
            help="The lens written by zoomjax calibrate, or the folder of its results, unless --lens is "
            "given; photos or videos, folders of them, patterns, or URLs of these.",
        ),
    ],
    output: FileOrFolder,
    lens: OtherLens = None,
    focal: FocalAtUse = None,
    hold: Hold = False,
    keep: Keep = "same",
    interpolation: Interpolation = "linear",
    border: Border = "constant",
    redistort: Redistort = False,
    again: Again = False,
    resume: Resume = False,
    overwrite: Replace = False,
    quiet: QuietWork = False,
    as_json: JsonOfWork = False,
    dry_run: DryRun = False,
    cluster: ClusterToCorrect = None,
) -> None:
    """Correct photos or videos, each image at its own focal length.

    Files that cannot be corrected are reported and skipped. The exit status
    is then 1, or 2 if all were skipped.
    """
    set_up_jax()
    from .cluster import cluster_executor
    from .undistort_files import Job, undistort_files

    inputs = at_hand(context, inputs, quiet=quiet)
    file, files = split_lens(inputs) if lens is None else (None, tuple(map(Path, inputs)))
    job = Job(file, files, output, focal, keep, interpolation, border, hold, overwrite)
    job = dataclasses.replace(job, redistort=redistort, again=again, resume=resume, dry_run=dry_run)
    with (
        cluster_executor(cluster, quiet=quiet) as executor,
        progress_bar("Correcting", timed=False, quiet=quiet or dry_run) as progress,
    ):
        if lens is None:
            done = undistort_files(job, progress, executor)
        else:
            from .library_lens import undistort_by_library

            done = undistort_by_library(job, lens, progress, executor)
    show_outcome(done, quiet=quiet, as_json=as_json)
    if done.skipped:
        raise typer.Exit(1 if done.written or dry_run else 2)
