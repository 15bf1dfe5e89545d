"""The tables of measured figures in README and docs: ``python -m docs.make tables``.

A table lies between ``<!-- table: NAME -->`` and ``<!-- end -->``. Its figures are taken from the pages and
files in benchmarks/results, as printed there; which rows and columns are shown, and what they are called,
is said here.
"""

import json
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from . import rooms

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"

BETWEEN = re.compile(r"(<!-- table: ([\w-]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)

Rows = list[list[str]]


def pages() -> list[Path]:
    """The pages that may have tables or measured figures: all that people read."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def update() -> list[Path]:
    """Write all tables again; return the pages that changed."""
    changed = []
    for page in pages():
        text = page.read_text()
        if (new := filled(text)) != text:
            page.write_text(new)
            changed.append(page)
    return changed


def filled(text: str) -> str:
    """A page with its tables as the results have them."""
    return BETWEEN.sub(lambda found: f"{found[1]}{TABLES[found[2]]()}\n{found[4]}", text)


@cache
def results(name: str) -> dict:
    """A JSON file of results."""
    return json.loads((RESULTS / name).read_text())


@cache
def sections(name: str) -> dict[str, str]:
    """The text of a page of results under each of its headings; '' is the whole page."""
    text = (RESULTS / name).read_text()
    parts = re.split(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {"": text} | dict(zip(parts[1::2], parts[2::2], strict=True))


def table_of(name: str, section: str = "") -> tuple[list[str], dict[str, list[str]]]:
    """The first table of a section of results: its heads, and its rows by their first cell."""
    heads, rows = rows_of(name, section)
    return heads, {row[0]: row for row in rows}


def rows_of(name: str, section: str = "") -> tuple[list[str], Rows]:
    """The first table of a section of results: its heads and its rows."""
    found = re.findall(r"(?:^\|.*\n)+", sections(name)[section], re.MULTILINE)[0]
    heads, _, *rows = ([cell.strip() for cell in row.split(" | ")] for row in _stripped(found))
    return heads, rows


def _stripped(table: str) -> list[str]:
    return [row.removeprefix("| ").removesuffix(" |") for row in table.replace("||", "|  |").splitlines()]


def markdown(heads: list[str], rows: Rows, *, texts: int = 1) -> str:
    """A table, its first columns of text and the others of numbers."""
    rule = ["---"] * texts + ["---:"] * (len(heads) - texts)
    return "\n".join(
        [f"| {' | '.join(heads)} |", f"|{'|'.join(rule)}|", *(f"| {' | '.join(row)} |" for row in rows)]
    )


def picked(
    source: tuple[list[str], dict[str, list[str]]], columns: dict[str, str], rows: dict[str, str]
) -> str:
    """Some rows and columns of a table, under other names."""
    heads, body = source
    at = [heads.index(head) for head in columns]
    chosen = [[shown, *(body[row][column] for column in at)] for row, shown in rows.items()]
    return markdown(["", *columns.values()], chosen)


DEGREES = {f"zoom polynomial, degree {n}": f"degree {n}" for n in range(4)}
DEGREES["zoom polynomial, degree 2"] = "**degree 2**"


def fit() -> str:
    """How long compression and fits take."""
    _, rows = table_of("fit.md")
    names = {
        "compression": "compression, once",
        "zoom fit, compressed": "zoom fit after it, with covariance and certificate",
        "robust fit, compressed": "robust fit after it",
        "frame by frame, compressed": "frame by frame after it",
        "compression for any centre": "compression for any centre, once",
        "zoom and centre fit after it": "zoom and centre fit after it",
        "zoom fit, full tensors": "the same zoom fit on the full tensors",
        "scipy.optimize.least_squares": "`scipy.optimize.least_squares` on the same residuals",
    }
    return markdown(["", "time", ""], [[shown, *rows[name][1:]] for name, shown in names.items()])


def whole(name: str) -> Callable[[], str]:
    """What makes the table of a page of results as it is."""
    return lambda: markdown(*rows_of(name))


def correct() -> str:
    """How long correcting takes, beside OpenCV and FFmpeg."""
    _, rows = table_of("correct.md")
    measured = {name: row[1] for name, row in rows.items()}
    shown = {
        "`undistort_image`, 1080p, linear, of `cv2.remap` alone": "1080p, linear: undistort_image / remap",
        "`undistort_image`, 1080p, linear, of OpenCV's map and remap": (
            "1080p, linear: undistort_image / OpenCV's map and remap"
        ),
        "`undistort_image`, 1080p, cubic, of OpenCV's map and remap": (
            "1080p, cubic: undistort_image / OpenCV's map and remap"
        ),
        "`undistort_image`, 12 megapixels, linear, of `cv2.remap` alone": (
            "12 MP, linear: undistort_image / remap"
        ),
        "`warp_image` (JAX, float32), of `cv2.remap`": "warp_image / remap, float32",
        "its gradient by the lens, of the warp": "gradient by the lens / forward",
        "its gradient by lens and image, of the warp": "gradient by lens and image / forward",
        "`undistort_video`, 1080p H.264, frame rate, of decoding and encoding alone, medium": (
            "undistort_video / no correction, frame rate, medium"
        ),
        "the same, veryfast": "undistort_video / no correction, frame rate, veryfast",
    }
    return markdown(["", "ratio"], [[name, measured[row]] for name, row in shown.items()])


def pipeline() -> str:
    """Points in a pipeline, beside the bare formula."""
    heads, rows = rows_of("pipeline.md")
    kept = [row for row in rows if row[0].startswith(("undistort", "distort"))]
    return markdown(["time of", "over that of", *heads[2:4]], [row[:4] for row in kept], texts=2)


def reproduced() -> str:
    """The paper's two tables, and ours."""
    rows = []
    for name, about in (("board", "Table 1, striped board"), ("football", "Table 2, football")):
        measured = [row for row in results("reproduce/reproduce.json")[name]["rows"] if row["unit"] == "px"]
        for whose, shown in (("paper", f"{about}: the paper"), ("ours", "here")):
            none, frames, zoom = (row[whose] for row in measured[:3])
            excess = f"{100 * (zoom / frames - 1):.2f} %"
            rows.append([shown, f"{none:.3f}", f"{frames:.3f}", f"{zoom:.3f}", excess])
    return markdown(["RMS, px", "no correction", "frame by frame", "degree 2", "excess"], rows)


def real() -> str:
    """Real lenses, each against what the model has not seen."""
    held_out = table_of("zoomcam.md", "Photos held out")[1]
    clips = table_of(
        "broadcast.md", "The centre known: the mean principal point of the frames learnt from"
    )[1]
    assumed = table_of("broadcast.md", "The centre assumed: the middle of the image")[1]
    pitch = table_of("pitch.md")[1]
    lenses = table_of("lensfun.md", "A focal length left out")[1]
    degree, each, none = "zoom polynomial, degree 2", "each frame by itself", "no correction"
    camera = [held_out[row][2].split(" ±")[0] for row in (none, "each zoom by itself", degree)]
    rows = [
        ["a zoom camera's checkerboard: other photos of the same zooms", *camera, "px off straight"],
        [
            "broadcast cameras of known lenses: other frames of the clip; centre of distortion known",
            *(clips[row][2] for row in (none, each, degree)),
            "px off the truth, over the image",
        ],
        [
            "the same, the centre taken to be the middle of the image",
            *(assumed[row][2] for row in (none, each, degree)),
            "px off the truth, over the image",
        ],
        [
            "annotated World Cup pitch lines: other frames",
            *(pitch[row][2] for row in (none, each, degree)),
            "px off straight",
        ],
        [
            "zooms of the lensfun database: a focal length left out, median",
            f"{results('lensfun.json')['none'][1]:.3f}",
            lenses["its own optimum (no model can do better)"][2],
            lenses["degree 2"][2],
            "px off straight",
        ],
    ]
    return markdown(["", "no correction", "by itself", "degree 2", ""], rows)


def trust_table(name: str) -> Callable[[], str]:
    """A table of trust.md as it is."""

    def table() -> str:
        found = results("trust.json")["tables"][name]
        return markdown(found["heads"], found["rows"], texts=len(found["heads"]))

    return table


def zoomcam() -> str:
    """The zoom camera in front of a board."""
    _, held_out = table_of("zoomcam.md", "Photos held out")
    _, left_out = table_of("zoomcam.md", "A zoom left out")
    names = {"no correction": "no correction", "each zoom by itself": "each zoom by itself", **DEGREES}
    names |= {
        name: name
        for name in ("table in f [25]", "table in 1/f [25]", "spline in 1/f", "power law, k1 alone [14]")
    }
    rows = []
    for name, shown in names.items():
        _, fitted, tested, excess = held_out[name]
        tested, excess = (cell.split(" ±")[0] for cell in (tested, excess))
        far, *_, near, middle, _ = left_out[name][1:]
        rows.append([shown, fitted, tested, f"{excess} %", middle, far, near])
    heads = ["in sample, px", "held out, px", "excess", "middle left out, px"]
    return markdown(["", *heads, "1× left out, px", "9× left out, px"], rows)


def broadcast() -> str:
    """Broadcast cameras whose lens is known."""
    names = {name: name for name in ("the true lens", "no correction", "each frame by itself")} | DEGREES
    names |= {"degree 2, k1 alone": "degree 2, k1 alone"}
    names |= {
        f"{name}{rest}": name
        for name, rest in (
            ("table in 1/f, 6 entries [25]", ""),
            ("spline in 1/f, 6 knots", ""),
            ("power law, k1 and k2", ""),
            ("power law, k1 alone [14]", ""),
        )
    }
    heading = "The centre known: the mean principal point of the frames learnt from"
    heads, _ = found = table_of("broadcast.md", heading)
    shown = ["straightness, px", "over the image, px", "corner, px", "95 %, px"]
    columns = dict(zip(heads[1:], shown, strict=True))
    return picked(found, columns, names)


def pitch() -> str:
    """Pitch lines marked by hand."""
    names = {"no correction": "no correction", "each frame by itself": "each frame by itself, k1 and k2"}
    names |= {"each frame by itself, k1 alone": "each frame by itself, k1 alone"} | DEGREES
    kept = (
        "degree 2, k1 alone",
        "table in 1/f, 5 entries [25]",
        "spline in 1/f, 5 knots",
        "power law, k1 alone [14]",
    )
    _, rows = table_of("pitch.md")
    cells = [
        [shown, rows[name][2], rows[name][4], rows[name][5]]
        for name, shown in (names | dict(zip(kept, kept, strict=True))).items()
    ]
    return markdown(["", "held out, px", "less degree 2, px", "95 %"], cells)


def lensfun() -> str:
    """Six hundred lenses, a focal length left out."""
    names = {
        **_SMOOTH,
        "degree chosen inside": "degree 1, 2 or 3, chosen by leaving out inside",
        "degree 2": "`PolynomialZoom`, degree 2",
        "degree 3": "degree 3",
        "power law": "`PowerZoom`",
        "spline in 1/f": "`SplineZoom` (natural, in 1/f, a knot at each focal length)",
        "table in 1/f": "`TableZoom` in 1/f",
        "table in f": "`TableZoom` in f",
        "degree 1": "degree 1",
    }
    found, models = results("lensfun.json"), results("lensfun.json")["models"]
    rows = [
        [shown, *map(_three, models[name]["left_out"]["rms"]), _three(models[name]["in_sample"]["rms"][1])]
        for name, shown in names.items()
    ]
    own = [*map(_three, found["frames_alone_interior"]), _three(found["frames_alone"][1])]
    rows.append(["the focal length's own optimum", *own])
    return markdown(["", "25 %", "median", "75 %", "90 %", "in sample, median"], rows)


_SMOOTH = {
    "SmoothZoom.for_lens, other half's prior": "`SmoothZoom.for_lens`, prior from other lenses",
    "SmoothZoom, other half's prior": "`SmoothZoom`, prior from other lenses",
}


def _three(figure: float) -> str:
    return f"{figure:.3f}"


def lensfun_few() -> str:
    """Six hundred lenses of which a few focal lengths are fitted."""
    names = {
        **_SMOOTH,
        "polynomial of degree 2, or the highest there is": "`PolynomialZoom`, degree 2 (of two: 1)",
        "table in 1/f": "`TableZoom` in 1/f",
    }
    return _few(results("lensfun.json")["few"], names)


def few_default() -> str:
    """What the command line gives for two or three focal lengths."""
    found = results("few_focal_lengths.json")
    names = {"default": "`zoomjax calibrate`", "polynomial": "with `--degree` 1 or 2"}
    rows = []
    for number in ("2", "3"):
        for setting, shown in names.items():
            of = found[number][setting]
            errors = np.quantile([row["image_px"] for row in of], (0.5, 0.75, 0.9))
            held = (100 * np.mean([row[kind]["image"] for row in of]) for kind in ("held", "held_by_both"))
            good = [row["image_px"] for row in of if row["verdict"] == "good"]
            worst = f"{max(good):.2f}" if good else ""
            rows.append(
                [
                    number,
                    shown,
                    *(f"{x:.2f}" for x in errors),
                    *(f"{x:.1f}" for x in held),
                    str(len(good)),
                    worst,
                ]
            )
    head = [
        "photographed",
        "",
        "median",
        "75 %",
        "90 %",
        "bands hold, %",
        "with calibrations', %",
        "good",
        "worst",
    ]
    return markdown(head, rows)


def lensfun_part() -> str:
    """The same lenses, of which the longer half of the range is photographed."""
    told = {"the same, told the ends fitted": "`SmoothZoom.for_lens` of that half"}
    return _few(results("lensfun.json")["part"]["errors"], _SMOOTH | told)


def _few(errors: dict, names: dict[str, str]) -> str:
    rows = [
        [number, shown, *map(_three, errors[name][number])]
        for number in errors[next(iter(names))]
        for name, shown in names.items()
    ]
    return markdown(["fitted", "", "25 %", "median", "75 %", "90 %"], rows)


def lensfun_forms() -> str:
    """Degrees of SmoothZoom."""
    found = re.findall(r"^(?:degree )?(.+): \[([\d. ]+)\]$", sections("lensfun-forms.md")[""], re.MULTILINE)
    rows = [[name, *(f"{float(figure):.3f}" for figure in figures.split())] for name, figures in found]
    return markdown(["degree", "25 %", "median", "75 %", "90 %"], rows)


def board_focal() -> str:
    """Focal lengths of a zoom camera from its photos of a board."""
    text = sections("focal.md")[""].partition("Board")[2]
    found = re.findall(
        r"^ +(\d+) +\d+ +\d+ +(\d+) +(\d+ \(.*?\)) +(\d+ \(.*?\)) +(\d+)$", text, re.MULTILINE
    )
    rows = [[zoom, theirs, one, f"{every}, ± {std}"] for zoom, theirs, one, every, std in found]
    return markdown(["zoom", "theirs, px", "median of single photos", "all photos together"], rows)


def board_rivals() -> str:
    """Bent boards, fitted by others, half against half."""
    found = results("board_rivals.json")
    names = {
        "`cv2.calibrateCamera`": "`cv2.calibrateCamera`, flat",
        "`cv2.calibrateCameraRO`": "`cv2.calibrateCameraRO`, corners free",
        "mrcal, OPENCV4, flat board": "mrcal, OPENCV4, flat",
        "mrcal, OPENCV4, bent board": "mrcal, OPENCV4, two parabolas",
    }
    fits = {"`fit_boards`": found["ours"]["pose"]}
    fits |= {shown: found["others"][name] for name, shown in names.items() if name in found["others"]}
    rows = [
        [
            name,
            f"{of['not_seen']:.3f}",
            f"{np.mean(of['scatter']):.3f}",
            f"{np.mean(of['scatter_bent']):.3f}",
            f"{100 * max(of['repeats']):.2f}",
        ]
        for name, of in fits.items()
    ]
    head = ["", "photos not seen, px", "lens, px", "beyond a homography, px", "f, %"]
    return markdown(head, rows)


def vision() -> str:
    """What detectors find, and how fast."""
    heads, rows = table_of("vision.md")
    return markdown(heads, list(rows.values()))


def focal_off() -> str:
    """Focal lengths of broadcast clips that are wrong, as given and refined."""
    return markdown(*rows_of("coverage.md", "Broadcast clips, focal lengths off"))


def motion(section: str) -> Callable[[], str]:
    """What makes a table of focal lengths and lenses from motion."""

    def make() -> str:
        heads, rows = table_of("motion.md", section)
        return markdown(["", *heads[1:]], list(rows.values()))

    return make


TABLES: dict[str, Callable[[], str]] = {
    "rooms": rooms.table,
    "fit": fit,
    "compiling": whole("compiling.md"),
    "end_to_end": whole("end_to_end.md"),
    "many": whole("many.md"),
    "correct": correct,
    "pipeline": pipeline,
    "reproduced": reproduced,
    "real": real,
    "coverage": trust_table("coverage"),
    "metrics": trust_table("metrics"),
    "outliers": trust_table("outliers"),
    "rounded-focal": trust_table("rounded_focal"),
    "focal-off": focal_off,
    "trust-cost": trust_table("cost"),
    "zoomcam": zoomcam,
    "broadcast": broadcast,
    "pitch": pitch,
    "lensfun": lensfun,
    "lensfun-few": lensfun_few,
    "few-default": few_default,
    "lensfun-part": lensfun_part,
    "lensfun-forms": lensfun_forms,
    "board-focal": board_focal,
    "board-rivals": board_rivals,
    "vision": vision,
    "motion": motion("Simulated tracks"),
    "motion-real": motion("Real lenses"),
    "motion-rendered": motion("Rendered clips"),
    "motion-broadcast": motion("Frames of a broadcast"),
    "motion-rivals": motion("Rivals"),
    "motion-shots": motion("Shots across a cut"),
    "motion-lenses": motion("Shots of one camera and of two"),
    "motion-tracking": motion("Tracking"),
    "motion-time": motion("Time"),
}
"""What makes each table, by the name in its marker."""
