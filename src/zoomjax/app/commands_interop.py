"""The commands for other tools' formats: ``zoomjax export``, ``import`` and ``formats``."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .._core.files import refuse_existing, refuse_inputs
from .._core.text import plain
from ._jax import set_up_jax
from .arguments import Overwrite, lens_file, size_of
from .commands import app
from .options import FocalUnit, ResultsFolder, place

if TYPE_CHECKING:
    from ..interop.base import Report

RESULTS = ("lens.json", "import.json")
"""What an import writes."""


@app.command("export")
def export(
    lens: Annotated[
        Path,
        typer.Argument(
            metavar="lens.json",
            help="The lens written by zoomjax calibrate, or the folder of its results.",
            callback=lens_file,
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help="Output file; a folder for STMaps, and where each focal length is a file.",
            callback=place,
        ),
    ],
    to: Annotated[str, typer.Option("--to", metavar="FORMAT", help="The format; see zoomjax formats.")],
    focal: Annotated[
        str | None,
        typer.Option(
            metavar="F,...|CSV",
            help="Focal lengths, separated by commas, or a CSV file with the columns frame,focal: an entry "
            "for each frame. Formats that interpolate choose them by themselves.",
        ),
    ] = None,
    pixel_pitch: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Pixel size on the sensor: the sensor's width over that of the image in px. Default: that "
            "in lens.json.",
        ),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            help="For formats that interpolate: largest error between the focal lengths written. Default: "
            "0.1.",
        ),
    ] = None,
    convention: Annotated[
        str | None,
        typer.Option(
            metavar="CONVENTION",
            help="For STMaps: centres (Nuke), gyroflow or alicevision. Default: centres.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
) -> None:
    """Write a lens in another tool's format, and report its error there."""
    set_up_jax()
    from ..interop.registry import write
    from ..io.focal_track import read_focal_track
    from ..models.lens import load_lens

    tracked = focal is not None and focal.lower().endswith(".csv")
    inputs = [lens, *([Path(focal)] if tracked and focal is not None else [])]
    refuse_inputs([output], inputs)
    for path in inputs if overwrite else []:
        if path.resolve().parent == output.resolve():
            raise ValueError(f"{path} is in the folder {output}, where files are replaced: choose another.")
    report = write(
        load_lens(lens),
        output,
        format=to,
        focal=None if tracked or focal is None else _numbers(focal),
        track=read_focal_track(Path(focal)) if tracked and focal is not None else None,
        pixel_pitch=pixel_pitch,
        tolerance=tolerance,
        convention=convention,
        overwrite=overwrite,
    )
    _show(report)
    print(f"Written to {plain(str(output))}.")


@app.command("import")
def import_(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="The file, or a folder of files of one format, one a focal length."
        ),
    ],
    output: ResultsFolder,
    of: Annotated[
        str | None,
        typer.Option("--from", metavar="FORMAT", help="The format; by default it is recognised."),
    ] = None,
    image_size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Image size in px, for files that do not say it, e.g. 6000x4000."),
    ] = None,
    focal: Annotated[
        str | None,
        typer.Option(
            metavar="F,...",
            help="Focal lengths of the files or entries, separated by commas, where these do not say them.",
        ),
    ] = None,
    focal_unit: Annotated[
        FocalUnit | None, typer.Option(help="Unit of --focal. Default: mm.", show_default=False)
    ] = None,
    crop: Annotated[
        float | None,
        typer.Option(
            metavar="FACTOR",
            help="For lensfun: crop factor of the camera; default: that of the calibration.",
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="For lensfun: name of the lens, or a part of it, for files of several.",
        ),
    ] = None,
    direction: Annotated[
        str | None,
        typer.Option(
            metavar="DIRECTION",
            help="For STMaps: undistort or redistort; default: what the file name says.",
        ),
    ] = None,
    convention: Annotated[
        str | None,
        typer.Option(
            metavar="CONVENTION",
            help="For STMaps: centres (Nuke), gyroflow or alicevision. Default: centres.",
        ),
    ] = None,
    distortion_model: Annotated[
        Literal["radial", "division", "brown-conrady"] | None,
        typer.Option(
            metavar="MODEL",
            help="Distortion model: radial (polynomial), division or brown-conrady (with decentering). "
            "Default: that which holds the file's coefficients, or is nearest to its maps.",
        ),
    ] = None,
    terms: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Number of radial coefficients. Default: 2, or those that keep the file's values.",
        ),
    ] = None,
    table: Annotated[
        bool,
        typer.Option(
            "--table",
            help="Keep the file's own values at its focal lengths, and the tool's own interpolation "
            "between; linear in 1/f where it has none.",
        ),
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Read a lens from another tool's file.

    Writes lens.json, and import.json with its error at the file's focal
    lengths.
    """
    set_up_jax()
    from ..interop.registry import read
    from ..models.tables import TableZoom
    from .model_choice import DISTORTION_MODELS
    from .results_folder import OF_A_LENS, results_folder

    inputs = list(source.iterdir()) if source.is_dir() else [source]
    refuse_inputs([output / name for name in RESULTS], inputs)
    if not (output / RESULTS[1]).exists():  # else it was imported, too, and not measured
        refuse_existing([output / RESULTS[0]], overwrite=overwrite)
    found = read(
        source,
        format=of,
        image_size=None if image_size is None else size_of(image_size),
        focal=None if focal is None else _numbers(focal),
        focal_unit=focal_unit,
        crop=crop,
        name=name,
        direction=direction,
        convention=convention,
        zoom=TableZoom() if table else None,
        terms=terms,
        distortion_model=None if distortion_model is None else DISTORTION_MODELS[distortion_model],
    )
    with results_folder(output, RESULTS, clears=OF_A_LENS, overwrite=overwrite) as folder:
        found.lens.save(folder / RESULTS[0])
        content = dataclasses.asdict(found.report) | {"files": [str(file) for file in found.report.files]}
        (folder / RESULTS[1]).write_text(json.dumps(content, indent=2) + "\n")
    _show(found.report)
    print(f"Written to {plain(str(output))}: {', '.join(RESULTS)}")


@app.command("formats")
def formats() -> None:
    """List the formats of other tools.

    Exact formats have our formula: a radial polynomial loses nothing but
    digits, up to the number of coefficients of the format. In others the
    tool's formula is refitted, and the error is reported.
    """
    from ..interop.registry import FORMATS

    rows = [("format", "direction", "formula", "zoom", "tools")]
    for fmt in FORMATS:
        ways = "export, import" if fmt.writes else "import"
        formula = "exact" if fmt.exact else "refitted"
        if fmt.exact_for is not None:
            formula += f", exact for {fmt.exact_for}"
        rows.append((fmt.name, ways, formula, _ZOOM[fmt.zoom], fmt.tools))
    widths = [max(map(len, column)) + 2 for column in zip(*rows, strict=True)]
    for row in rows:
        print("".join(f"{word:<{width}}" for word, width in zip(row, widths, strict=True)).rstrip())


_ZOOM = {
    "one": "one zoom a file",
    "list": "an entry a zoom or frame",
    "interpolated": "interpolated",
}
"""What a format knows of zooming, in words."""


def _show(report: "Report") -> None:
    for line in str(report).splitlines():
        print(plain(line.replace("a table, TableZoom(), keeps", "--table keeps")))


def _numbers(text: str) -> list[float]:
    """Numbers separated by commas."""
    from ..io.text_table import plain_number

    found = [plain_number(part) for part in text.split(",")]
    if None in found:
        raise ValueError(f"--focal must be focal lengths separated by commas, but it is {text!r}.")
    return [number for number in found if number is not None]
