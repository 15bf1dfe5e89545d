"""Lenses in the formats of other tools: the error of each, focal lengths written, and times.

    pip install '.[bench,interop]'
    python -m benchmarks.interop [--every N] [--output FILE]

One strong zoom, 18 to 200 mm, +7 % to -2 % at the corner of 4288 x 2848 px, is written in every format and
read again. Then the zooms of the lensfun database, every N-th, are read and written again as lensfun files.
Errors are those of the reports: the greatest over the image, at the focal lengths written and between,
where the tool interpolates. What lensfun reads or writes is judged in the distorted image, up to a
magnification of each focal length.
"""

import argparse
import importlib.metadata
import tempfile
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import jax
import numpy as np

import zoomjax as zj

from .shared import RESULTS, machine, machine_line, table, write

SIZE, PITCH = (4288, 2848), 0.0055
FOCAL = [18.0, 24.0, 35.0, 50.0, 85.0, 200.0]
MAP_SIZE = (1920, 1080)
"""Of STMaps, whose time is that of their pixels."""

TOLERANCE = 0.1
"""px, the default."""

_NAMED = 5
"""Lenses that are named for their errors."""


def strong_zoom(size: tuple[int, int]) -> zj.ZoomLens:
    """18 to 200 mm."""
    k = np.array([[-0.022, 0.002], [0.095, -0.015], [-0.006, 0.0]])
    centre = (np.array(size) - 1) / 2 + 6.5
    return zj.ZoomLens(zj.PolynomialZoom(2, k, np.array(18.0)), centre, np.array([18.0, 200.0]), size)


def measure_format(fmt: zj.interop.Format, folder: Path) -> dict:
    """Write and read one format."""
    lens = strong_zoom(MAP_SIZE if fmt.name == "stmap" else SIZE)
    path = folder / (fmt.name if fmt.zoom == "one" else f"{fmt.name}{fmt.suffixes[0]}")
    focal = None if fmt.zoom == "interpolated" else FOCAL
    start = time.perf_counter()
    out = zj.interop.write(lens, path, format=fmt.name, focal=focal, pixel_pitch=PITCH)
    middle = time.perf_counter()
    silent = FOCAL if fmt.name in ("nuke", "pftrack", "discorpy") else None
    back = zj.interop.read(path, image_size=lens.image_size, focal=silent).report
    return {
        "exact": fmt.exact,
        "focal": len(out.focal),
        "at_nodes": out.at_nodes,
        "between": out.between,
        "read": back.at_nodes,
        "write_s": middle - start,
        "read_s": time.perf_counter() - middle,
    }


def database() -> list[ET.Element]:
    """The rectilinear zooms of lensfun's database."""
    import lensfunpy

    lenses = []
    for path in sorted((Path(lensfunpy.__file__).parent / "db_files").glob("*.xml")):
        for lens in ET.parse(path).getroot().iter("lens"):
            entries = lens.findall("calibration/distortion")
            straight = (lens.findtext("type") or "rectilinear") == "rectilinear"
            if straight and len({entry.get("focal") for entry in entries}) > 1:
                lenses.append(lens)
    return lenses


def measure_database(lenses: list[ET.Element], folder: Path) -> dict:
    """Read lenses, and write them again."""
    read, written, nodes, refused, seconds, smooth, silent = [], [], [], [], [], 0, []
    for lens in lenses:
        root = ET.Element("lensdatabase", version="1")
        root.append(lens)
        ET.ElementTree(root).write(folder / "in.xml")
        start = time.perf_counter()
        found = zj.interop.read(folder / "in.xml", image_size=SIZE)
        seconds.append(time.perf_counter() - start)
        read.append(found.report.worst)
        smooth += isinstance(found.lens.zoom, zj.SmoothZoom)
        try:
            report = zj.interop.write(found.lens, folder / "out.xml", format="lensfun", overwrite=True)
            written.append(report.worst)
            if report.worst > TOLERANCE and "0.1 px" not in str(report):
                silent.append(lens.findtext("model"))
            nodes.append(len(report.focal))
        except ValueError:
            refused.append(lens.findtext("model"))
    return {
        "names": [lens.findtext("model") for lens in lenses],
        "silent": silent,
        "read": read,
        "smooth": smooth,
        "written": written,
        "nodes": float(np.median(nodes)),
        "refused": refused,
        "median_read_s": float(np.median(seconds)),
    }


def _worst(found: dict, key: str) -> str:
    """The lenses of the greatest errors."""
    names = [name for name in found["names"] if key == "read" or name not in found["refused"]]
    order = np.argsort(-np.array(found[key]))[:_NAMED]
    return ", ".join(f"{names[i]} ({found[key][i]:.1f} px)" for i in order)


def page(results: dict) -> str:
    """The results as a page."""
    ways = {fmt.name: "out, in" if fmt.writes else "in" for fmt in zj.interop.formats()}
    unwritten = ", ".join(name for name, way in ways.items() if way == "in")
    rows = [
        [
            name,
            ways[name],
            "exact" if row["exact"] else "refitted",
            str(row["focal"]),
            f"{row['at_nodes']:.2g}",
            "" if row["between"] is None else f"{row['between']:.2g}",
            f"{row['read']:.2g}",
            f"{row['write_s']:.1f}",
            f"{row['read_s']:.1f}",
        ]
        for name, row in results["formats"].items()
    ]
    head = ["", "direction", "formula", "focal lengths", "error at them, px", "between, px"]
    found = results["database"]
    errors = [
        [
            name,
            f"{np.median(found[key]):.2f}",
            f"{np.quantile(found[key], 0.9):.2f}",
            f"{max(found[key]):.1f}",
        ]
        for name, key in (
            ("read, against lensfun's table", "read"),
            ("written for lensfun again, against the lens", "written"),
        )
    ]
    return "\n".join(
        [
            "# Lenses in the formats of other tools",
            "",
            f"`python -m benchmarks.interop --every {results['every']}`: errors are the greatest over the "
            "image.",
            "",
            "## A strong zoom in every format",
            "",
            f"18 to 200 mm at {SIZE[0]} x {SIZE[1]} px (maps: {MAP_SIZE[0]} x {MAP_SIZE[1]} px), tolerance "
            "0.1 px. Read again, the error is that of the zoom model through the file's focal lengths. "
            f"Times are of a first call, with compiling. Read only: {unwritten}.",
            "",
            *table([*head, "read again, px", "writing, s", "reading, s"], rows),
            "",
            "## The lensfun database",
            "",
            f"{len(found['read'])} of its {results['lenses']} rectilinear zooms, at {SIZE[0]} x {SIZE[1]} "
            "px: the greatest error of each lens over the image and all focal lengths, px of the distorted "
            f"image, up to a magnification. {found['smooth']} become a SmoothZoom, the others a TableZoom. "
            f"{len(found['refused'])} fold over within the image and are not written. Written again, they "
            f"have {found['nodes']:.0f} focal lengths in the median. "
            f"{sum(error > TOLERANCE for error in found['written'])} are farther than the tolerance of "
            f"{TOLERANCE:g} px, and {len(found['silent'])} reports do not say so.",
            "",
            *table(["", "median", "90 %", "worst"], errors),
            "",
            *(f"Worst {way}: {_worst(found, way)}." for way in ("read", "written")),
            "",
            machine_line(results["machine"]),
            "",
        ]
    )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=RESULTS / "interop.md")
    parser.add_argument("--every", type=int, default=1, help="use every N-th lens of the database")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    versions = {name: importlib.metadata.version(name) for name in ("lensfunpy", "OpenEXR")}
    lenses = database()
    with tempfile.TemporaryDirectory() as name:
        both = [fmt for fmt in zj.interop.formats() if fmt.writes]
        results = {
            "machine": machine() | versions,
            "every": options.every,
            "lenses": len(lenses),
            "formats": {fmt.name: measure_format(fmt, Path(name)) for fmt in both},
            "database": measure_database(lenses[:: options.every], Path(name)),
        }
    write(options.output, page(results), results)


if __name__ == "__main__":
    main()
