"""Arguments of the command line: checks, and conversion to arguments of the library."""

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .options import FIT, FOCAL, OUTPUT

if TYPE_CHECKING:
    from ..lines.lines import Lines
    from .board_focals import Board
    from .image_job import ImageJob


Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Also replace files that zoomjax did not write, or that were changed since.",
        rich_help_panel=OUTPUT,
    ),
]
ModelName = Annotated[
    str | None,
    typer.Option(
        "--model",
        metavar="MODEL",
        help="Zoom model: auto (of least cross-validation error), polynomial (in 1/f), smooth (with a "
        "prior from real lenses) or spline. Default: auto, or polynomial with --degree.",
        rich_help_panel=FIT,
    ),
]
Degree = Annotated[
    int | None,
    typer.Option(
        min=0,
        metavar="N",
        help="Degree of the polynomials in 1/f. Default: by cross-validation; 2 with --model polynomial.",
        rich_help_panel=FIT,
    ),
]
Terms = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="Number of coefficients, k1 to kN. Default: by cross-validation; 2 with --model or --degree.",
        rich_help_panel=FIT,
    ),
]
DistortionModel = Annotated[
    Literal["radial", "division", "brown-conrady", "auto"] | None,
    typer.Option(
        metavar="MODEL",
        help="Distortion model: radial (polynomial), division (strong barrel distortion), brown-conrady "
        "(the polynomial with decentering) or auto (of least cross-validation error). Default: radial; "
        "for a strong lens, the better of radial and division.",
        rich_help_panel=FIT,
    ),
]
Centre = Annotated[
    str | None,
    typer.Option(
        metavar="fit|moving|image|X,Y",
        help="Centre of distortion: fit (where the lines determine it, else the image's), moving (along "
        "the zoom, as a line of 1/f, where lines left out are no less straight), image, or its "
        "coordinates in px. Default: fit, but image with --distortion-model brown-conrady.",
        rich_help_panel=FIT,
    ),
]

KnownFocal = Annotated[
    list[str] | None,
    typer.Option(
        "--known-focal",
        metavar="F@FRAME|CSV|plane|pitch",
        help="With --focal motion: the focal length of a frame, counted from 0, such as 24@0, or a CSV "
        "file with frame,focal[,sigma] of some frames; may be repeated. In mm it needs --pixel-pitch; or "
        "give --focal-unit px. Or what tells it in the frames of --lines: plane, a flat grid seen "
        "obliquely, or pitch. One is needed where the camera zooms without turning.",
        rich_help_panel=FOCAL,
    ),
]


def read_lines(
    inputs: list[Path],
    focal: str | None,
    image_size: str | None,
    focal_unit: str | None,
    focal_sigma: str | None = None,
) -> "Lines":
    """Read files of lines, the frames of each after those of the files before it."""
    from .focal_sources import refuse_sigma_column

    for index, path in enumerate(inputs):
        if path.resolve() in [other.resolve() for other in inputs[:index]]:
            raise ValueError(f"{path} is given twice: its lines would count twice.")
    parts = [_read_lines(path, focal, image_size, focal_unit) for path in inputs]
    for path in [*inputs, *([] if focal is None else [focal])]:
        refuse_sigma_column(path, focal_sigma)
    if len(parts) == 1:
        return parts[0]
    _refuse_frames_again(inputs, parts)
    from ..fit.concatenation import concatenate

    try:
        return concatenate(parts)
    except ValueError as error:
        told = str(error).replace("Argument parts", "The files of lines")
        for index, path in reversed([*enumerate(inputs)]):
            told = told.replace(f"parts[{index}]", str(path))
        raise ValueError(told) from error


def _refuse_frames_again(inputs: list[Path], parts: "list[Lines]") -> None:
    """Refuse files of which one holds a frame of another: a copy, or of two results with photos in common.

    Raises:
        ValueError: the lines of two frames are the same to the last digit of a float32.
    """
    import numpy as np

    first: dict[tuple[bytes, ...], tuple[int, int]] = {}
    for file, part in enumerate(parts):
        frame, points = np.asarray(part.frame), part.to_ragged()
        for number in range(len(part.focal)):
            own = [np.asarray(points[line], np.float32) for line in np.flatnonzero(frame == number)]
            lines = sorted(line.tobytes() for line in own)
            earlier, other = first.setdefault(tuple(lines), (file, number))
            if earlier != file:
                raise ValueError(
                    f"{inputs[file]} holds a frame of {inputs[earlier]} again, {number} here and {other} "
                    "there: its lines would count twice. Give files that have no frames in common."
                )


def results_of(path: str) -> Path | None:
    """The lines of a folder of results; None if it is something else.

    Raises:
        ValueError: the results are those of a clip without lines, and the folder has no other pictures.
    """
    folder = Path(path)
    lines, has = folder / "lines.npz", {one.name for one in folder.glob("*")}
    if not {"lens.json", "tracks.npz", "track.csv"} <= has or lines.is_file():
        return lines if lines.is_file() and (folder / "lens.json").is_file() else None
    if not has <= _OF_A_CLIP:
        return None  # photos may be among them
    raise ValueError(
        f"{path} holds the results of a clip without lines, so there is nothing to fit again: calibrate "
        "the clip itself, with --lines if straight lines in its frames are to count, too."
    )


def with_lines_of_results(inputs: list[str], *, meant: bool) -> list[str]:
    """The inputs; in place of folders of results, their lines.

    Args:
        inputs: as they are given.
        meant: whether an option says that lines are to be fitted, and not photos.

    Raises:
        ValueError: a folder holds photos, too, which the lines need not be of.
    """
    from ..detect.sources import files_within
    from ..io.photo import SUFFIXES

    found = {path: lines for path in inputs if (lines := results_of(path))}
    for path, lines in () if meant else found.items():
        if photos := files_within(Path(path), SUFFIXES):
            raise ValueError(
                f"{path} holds photos, such as {photos[0]}, and the results of a calibration: give {lines} "
                f"to fit its lines again, or the photos, as by {photos[0].with_stem('*')}."
            )
    return [str(found.get(path, path)) for path in inputs]


_OF_A_CLIP = {
    *("lens.json", "summary.json", "report.html", "tracks.npz", "track.csv", "motion.png", "panorama.jpg"),
    ".zoomjax.json",
}
"""What a calibration from a clip without lines leaves in its folder."""


def refits(inputs: list[Path], target: Path) -> bool:
    """Whether a result is the one input: lines that are fitted again where they are, and stay there."""
    return (
        len(inputs) == 1 and target.name == "lines.npz" and target.exists() and inputs[0].samefile(target)
    )


def _read_lines(path: Path, focal: str | None, image_size: str | None, focal_unit: str | None) -> "Lines":
    kind = path.suffix.lower()
    if kind == ".npz":
        if (focal, image_size, focal_unit) != (None, None, None):
            raise ValueError(
                f"{path} contains focal lengths and image size: leave out --focal, --image-size and "
                "--focal-unit, which are for CSV files."
            )
        from ..lines.npz import load_lines

        return load_lines(path)
    if kind == ".csv":
        from ..lines.csv import read_lines_csv

        if (size := size_of(image_size)) is None:
            raise ValueError(f"The image size of {path} is not known: give --image-size, e.g. 1920x1080.")
        if focal == "same" and focal_unit is not None:
            raise ValueError("--focal same has no unit, for f is not known: leave out --focal-unit.")
        return read_lines_csv(
            path, image_size=size, focal=_focal_of_lines(path, focal), focal_unit=focal_unit or "mm"
        )
    raise ValueError(f"Cannot calibrate from {path}: give lines.npz, or a CSV file frame,line,x,y[,focal].")


def _focal_of_lines(path: Path, focal: str | None) -> "dict[int, float] | float | None":
    """The focal lengths of a CSV of lines: by frame, or one of all frames, as of photos."""
    import numpy as np

    from .._core.fields import check_focal
    from ..io.text_table import plain_number
    from ..lines.csv import read_focal_csv

    if focal is None or focal.lower().endswith(".csv"):
        return None if focal is None else read_focal_csv(Path(focal))
    if focal == "same":
        return 1.0  # it stands for what nobody knows
    number = plain_number(focal)
    if number is None or number <= 0:
        raise ValueError(
            f"--focal for {path} must be a CSV file with the columns frame,focal, or one focal length of "
            f"all frames: a positive number, or same if it is not known; but it is {focal!r}."
        )
    check_focal("focal", np.asarray(number))
    return number


def centre_of(text: str) -> Literal["fit", "moving", "image"] | tuple[float, float]:
    """The centre of distortion as `calibrate` takes it."""
    from ..io.text_table import plain_number

    if text == "fit" or text == "moving" or text == "image":
        return text
    numbers = [plain_number(part) for part in text.split(",")]
    x, y = numbers if len(numbers) == 2 else (None, None)
    if x is None or y is None:
        raise ValueError(
            f"--centre must be fit, moving, image, or X,Y in px as in 959.5,539.5, but it is {text!r}."
        )
    return x, y


def at_hand(context: typer.Context, inputs: list[str], *, quiet: bool) -> list[str]:
    """The inputs; in place of URLs, copies that are there until the command ends."""
    from .._core.copies import is_url

    if not any(map(is_url, inputs)):
        return inputs
    from ..detect.sources import MARKS, VIDEO_SUFFIXES
    from ..io.local_copies import local_copies
    from ..io.photo import SUFFIXES
    from .console import progress_bar

    with progress_bar("Copying", quiet=quiet) as progress:
        kinds = SUFFIXES, VIDEO_SUFFIXES
        return context.with_resource(local_copies(inputs, kinds=kinds, besides=MARKS, progress=progress))


def split_lens(inputs: list[str]) -> tuple[Path, tuple[Path, ...]]:
    """The file of the lens, which comes first, and what to correct."""
    if len(inputs) < 2:
        raise ValueError(
            "Give the lens and then what to correct: lens.json photos/*.jpg. Without a lens of your own, "
            "--lens auto takes that of the EXIF data."
        )
    return lens_file(Path(inputs[0])), tuple(map(Path, inputs[1:]))


def lens_file(given: Path) -> Path:
    """The file of a lens, for which the folder of results that it is in stands, too.

    Raises:
        FileNotFoundError: there is none in the folder.
    """
    if not given.is_dir():
        return given
    if not (given / "lens.json").is_file():
        raise FileNotFoundError(
            f"The folder {given} has no lens.json: give that of zoomjax calibrate, or the file of a lens."
        )
    return given / "lens.json"


def size_of(text: str | None) -> tuple[int, int] | None:
    """Width and height from WxH."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not all(side.isascii() and side.isdigit() and int(side) for side in (width, height)):
        raise ValueError(f"--image-size must be like 1920x1080, but it is {text!r}.")
    return int(width), int(height)


def number_of_cores() -> int:
    """The number of cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def unit_of(given: str | None) -> str:
    """Check the unit of focal lengths; by default mm."""
    if given not in (None, "mm", "px"):
        raise ValueError(f"--focal-unit must be mm or px, but it is {given!r}.")
    return given or "mm"


def board_of(spacing: str | None, distance: float | None, pixel_pitch: float | None) -> "Board | None":
    """The board, if one is given."""
    from .._core.pixels import check_pitch
    from .board_focals import Board

    if spacing is distance is pixel_pitch is None:
        return None
    spacings = [_positive(part) for part in (spacing or "").lower().split("x")]
    given = {
        "--spacing": all(spacings),
        "--distance": 0 < (distance or 0) < math.inf,
        "--pixel-pitch": 0 < (pixel_pitch or 0) < math.inf,
    }
    bad = [name for name, good in given.items() if not good]
    if bad or len(spacings) > 2 or distance is None or pixel_pitch is None:
        raise ValueError(
            "A board needs --spacing (MM, or MMxMM across and down), --distance and --pixel-pitch (of the "
            f"sensor), all positive and in mm. Missing or wrong: {', '.join(bad or ['--spacing'])}."
        )
    check_pitch(pixel_pitch)
    return Board((spacings[0], spacings[-1]), distance, pixel_pitch)


def _positive(text: str) -> float:
    """The number, or 0 if the text is not a positive number."""
    from ..io.text_table import plain_number

    return max(plain_number(text) or 0.0, 0.0)


def refuse_to_replace(job: "ImageJob", output: Path) -> None:
    """Refuse to overwrite the input photos."""
    from ..detect.sources import RESULTS

    results = {(output / name).resolve() for name in RESULTS}
    for source in job.sources()[0] if job.video is None else ():
        real = (source.path or Path()).resolve()
        if results.intersection((real, *real.parents)):
            raise ValueError(f"The results would replace the photo {source.path}: give another folder.")
