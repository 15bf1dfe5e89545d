"""Options of the command line that commands share, and the examples in their help."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from .._core.files import settled

FIT, FOCAL, INPUT, OUTPUT = "Lens", "Focal lengths", "Images and lines", "Output"
USE, PICTURE = "Lens and focal lengths", "Picture"
"""Panels of the help."""

Detector = Literal["edges", "grid", "pitch"]
FocalUnit = Literal["mm", "px"]
SharedBy = Literal["exif", "folder", "similarity"]
OverlaysOf = Literal["some", "all", "none"]

Strict = Annotated[
    bool,
    typer.Option("--strict", help="End with status 3 unless the verdict is good.", rich_help_panel=OUTPUT),
]
Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet", "-q", help="Print the verdict, warnings and errors only.", rich_help_panel=OUTPUT
    ),
]
Verbose = Annotated[
    bool,
    typer.Option(
        "--verbose",
        "-v",
        help="Also print a table of all frames, and the versions of what was run.",
        rich_help_panel=OUTPUT,
    ),
]
AsJson = Annotated[
    bool,
    typer.Option(
        "--json",
        help="Print summary.json instead of the tables; with --dry-run, the plan.",
        rich_help_panel=OUTPUT,
    ),
]
DryRun = Annotated[
    bool,
    typer.Option("--dry-run", help="Say what would be read and written, and stop.", rich_help_panel=OUTPUT),
]
Overlays = Annotated[
    OverlaysOf,
    typer.Option(
        help="For images: which ones to draw with their lines. some: all up to 200, beyond that the "
        "worst and others over the zoom.",
        rich_help_panel=OUTPUT,
    ),
]
WithLines = Annotated[
    bool,
    typer.Option(
        "--lines",
        help="With --focal motion: fit the straight lines that the detector finds in the frames, too.",
        rich_help_panel=INPUT,
    ),
]
Frames = Annotated[
    int,
    typer.Option(
        min=1,
        metavar="N",
        help="For a video: maximum number of frames in which lines are detected.",
        rich_help_panel=INPUT,
    ),
]


_CLUSTER: dict[str, Any] = {
    "metavar": "tcp://HOST:PORT",
    "help": "Run on the Dask cluster whose scheduler has this address, one task for each photo or segment "
    "of a video. Workers and this machine must find the files by the same paths.",
}
Cluster = Annotated[str | None, typer.Option(**_CLUSTER, rich_help_panel=INPUT)]
ClusterToCorrect = Annotated[str | None, typer.Option(**_CLUSTER)]


def place(output: Path | None) -> Path | None:
    """Where results go, whatever folders are made on the way; for the options `--output`."""
    return None if output is None else settled(output)


ResultsFolder = Annotated[
    Path,
    typer.Option(
        "-o", "--output", metavar="DIR", help="Folder for the results.", file_okay=False, callback=place
    ),
]
FileOrFolder = Annotated[
    Path,
    typer.Option(
        "-o",
        "--output",
        metavar="OUT",
        help="Output file for a single input, else a folder.",
        callback=place,
    ),
]
Exclude = Annotated[
    list[str] | None,
    typer.Option(
        metavar="LINE",
        help="For a file of lines: leave out lines by their numbers in overlays and report, e.g. 15,17; "
        "may be repeated.",
        rich_help_panel=INPUT,
    ),
]

Focal = Annotated[
    str | None,
    typer.Option(
        metavar="SOURCE",
        help="Source of the focal lengths: a CSV file (columns image,focal; for a video time,focal or "
        "frame,focal; for CSV lines frame,focal), a number, same (one for all photos or frames, unknown), "
        "exif, board (parallel to the sensor), plane (oblique views of a flat grid), pitch (football "
        "markings), or for a video motion (as the camera turns and zooms). Default for photos: board if "
        "--spacing is given, else exif, else plane (with --detector pitch: pitch); for a video: motion.",
        rich_help_panel=FOCAL,
    ),
]
FocalUnits = Annotated[
    FocalUnit | None,
    typer.Option(help="Unit of focal lengths in a CSV file or number. Default: mm.", rich_help_panel=FOCAL),
]
FocalSigma = Annotated[
    str | None,
    typer.Option(
        metavar="STD",
        help="Standard deviation of the focal lengths, in their unit or per cent, e.g. 0.3 or 1%. "
        "Standard deviations of the results include it. Default: what plane, board or pitch estimate, "
        "for photos the CSV column sigma, or else 0; of --known-focal 1%.",
        rich_help_panel=FOCAL,
    ),
]
SharedFocal = Annotated[
    SharedBy | None,
    typer.Option(
        help="With --focal plane: photos of one zoom share one focal length, estimated from all of them "
        "together. Photos are of one zoom if they have one EXIF focal length (exif), are in one folder "
        "(folder), or have focal lengths that agree within their standard deviations (similarity).",
        rich_help_panel=FOCAL,
    ),
]
Spacing = Annotated[
    str | None,
    typer.Option(
        metavar="MM[xMM]",
        help="For --focal board: distance between neighbouring lines of the board, across and down.",
        rich_help_panel=FOCAL,
    ),
]
Distance = Annotated[
    float | None,
    typer.Option(
        metavar="MM",
        help="For --focal board: distance from the camera to the board.",
        rich_help_panel=FOCAL,
    ),
]
PixelPitch = Annotated[
    float | None,
    typer.Option(
        metavar="MM",
        help="For --focal board, and --known-focal in mm: distance between pixels on the sensor.",
        rich_help_panel=FOCAL,
    ),
]

OtherLens = Annotated[
    str | None,
    typer.Option(
        metavar="auto|NAME",
        help="A lens of the library (see zoomjax lens) instead of lens.json: auto, the one in each photo's "
        "EXIF data, or its name.",
        rich_help_panel=USE,
    ),
]
FocalAtUse = Annotated[
    str | None,
    typer.Option(
        metavar="F|CSV",
        help="A focal length, or a CSV file: columns time,focal or frame,focal for a video, image,focal "
        "for photos; for several videos a folder of such files with their names. Default for photos: "
        "their EXIF data.",
        rich_help_panel=USE,
    ),
]
Hold = Annotated[
    bool,
    typer.Option(
        "--hold",
        help="Use the first and last focal length of a track beyond its ends.",
        rich_help_panel=USE,
    ),
]
Keep = Annotated[
    str,
    typer.Option(
        metavar="same|all|valid|grow",
        help="Framing of the corrected image: same (as the input), all (every input pixel), valid (no "
        "empty borders) or grow (every input pixel at its size, on a larger canvas). The framing stays "
        "constant while zooming.",
        rich_help_panel=PICTURE,
    ),
]
Interpolation = Annotated[
    str,
    typer.Option(
        metavar="METHOD",
        help="Interpolation: nearest, linear, cubic or lanczos.",
        rich_help_panel=PICTURE,
    ),
]
Border = Annotated[
    str,
    typer.Option(
        metavar="FILL",
        help="Fill outside of the input image: constant (black), replicate or reflect.",
        rich_help_panel=PICTURE,
    ),
]
Redistort = Annotated[
    bool,
    typer.Option(
        "--redistort",
        help="The reverse: apply the distortion to corrected images.",
        rich_help_panel=PICTURE,
    ),
]
Again = Annotated[
    bool,
    typer.Option(
        "--again",
        help="Also accept photos that zoomjax has corrected already.",
        rich_help_panel=OUTPUT,
    ),
]
Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Leave what an earlier run has written, and do the rest.",
        rich_help_panel=OUTPUT,
    ),
]
Replace = Annotated[
    bool,
    typer.Option("--overwrite", help="Replace existing files, but never an input.", rich_help_panel=OUTPUT),
]
QuietWork = Annotated[
    bool,
    typer.Option("--quiet", "-q", help="Print warnings and errors only.", rich_help_panel=OUTPUT),
]
JsonOfWork = Annotated[
    bool,
    typer.Option(
        "--json",
        help="Print what was written and skipped as JSON instead of sentences.",
        rich_help_panel=OUTPUT,
    ),
]

IDLE_FOR_LINES = (
    *("spacing", "distance", "pixel_pitch", "jobs", "detector", "frames", "cache", "overlays"),
    *("with_lines", "known_focal", "shared_focal", "cluster"),
)
"""Parameters of calibrate that say nothing about a file of lines."""

IDLE_FOR_MOTION = (
    *("spacing", "distance", "robust"),
    *("shared_focal", "cluster", "verbose"),
)
"""And about a clip whose motion gives its focal lengths."""

CALIBRATE_EXAMPLES = """\
Examples:

  zoomjax calibrate photos/ -o mylens

  zoomjax calibrate photos/*.jpg --focal focal.csv -o mylens

  zoomjax calibrate zoom/*mm/ --focal plane --shared-focal folder -o mylens

  zoomjax calibrate zoom.mp4 --focal track.csv -o mylens

  zoomjax calibrate still.mp4 --known-focal 24@0 --pixel-pitch 0.0055 -o mylens

  zoomjax calibrate fisheye/ --distortion-model division -o mylens

  zoomjax calibrate mylens --exclude 15,17 -o mylens
"""

UNDISTORT_EXAMPLES = """\
Examples:

  zoomjax undistort mylens/lens.json photo.jpg -o corrected.jpg

  zoomjax undistort mylens/lens.json clip.mp4 --focal track.csv -o corrected.mp4

  zoomjax undistort mylens/lens.json shoot -o corrected --resume

  zoomjax undistort mylens/lens.json plate.tif --keep grow -o overscan.tif

  zoomjax undistort mylens/lens.json photos/ --cluster tcp://192.168.0.5:8786 -o corrected
"""


def refuse_idle(context: typer.Context, names: Iterable[str], where: str) -> None:
    """Refuse options that have no effect.

    Args:
        context: of the running command.
        names: of the command's parameters.
        where: for what they have none, in words.

    Raises:
        ValueError: some of them are given.
    """
    given = [
        _flag(parameter, context.params[name])
        for parameter in context.command.params
        if (name := parameter.name) in names and _is_given(context, name)
    ]
    if given:
        has, them = ("has", "it") if len(given) == 1 else ("have", "them")
        raise ValueError(f"{' and '.join(given)} {has} no effect {where}: leave {them} out.")


_OF_A_UNIT = (None, "exif", "board", "plane", "pitch", "same")
"""Sources of focal lengths that tell their unit."""


def refuse_idle_sources(context: typer.Context, focal: str | None) -> None:
    """Refuse options about another source of focal lengths of photos than the one that is used."""
    if focal in _OF_A_UNIT:
        source = f"with --focal {focal}" if focal else "without --focal"
        refuse_idle(context, ("focal_unit",), f"{source}, for it is the unit of a number or a CSV file")
    if focal not in (None, "board"):
        refuse_idle(context, ("spacing", "distance", "pixel_pitch"), f"with --focal {focal}")


def refuse_auto(model: str | None, degree: int | None) -> None:
    """Refuse a model that is to be chosen and is given."""
    if model == "auto" and degree is not None:
        raise ValueError("--model auto has no effect with --degree, which gives the model: leave out one.")


def _is_given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name != "DEFAULT"


def _flag(parameter: Any, value: object) -> str:
    """What was written for a parameter to have a value."""
    off = parameter.secondary_opts
    return off[0] if off and value is False else max(parameter.opts, key=len)


def detector_for(context: typer.Context, detector: Detector, focal: str | None) -> Detector:
    """The detector: as given, else that of markings where these give the focal length."""
    given = str(context.get_parameter_source("detector")).endswith("COMMANDLINE")
    return "pitch" if focal == "pitch" and not given else detector


def excluded(given: list[str] | None, files: Sequence[Path]) -> list[int]:
    """Line numbers from the option, for files of lines.

    Raises:
        ValueError: one is not a whole number of at least 0; or there are several files.
    """
    if given and len(files) > 1:
        raise ValueError(
            "--exclude is for one file of lines: of several, overlays and reports number the lines of each "
            "by itself. Calibrate them together, and then the results of that, with --exclude."
        )
    words = [word.strip() for text in given or () for word in text.split(",")]
    for word in words:
        if not (word.isascii() and word.isdigit()):
            raise ValueError(f"--exclude must be numbers of lines such as 15 or 15,17, but it is {word!r}.")
    return sorted({int(word) for word in words})
