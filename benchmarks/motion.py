"""Focal lengths and the lens from how a clip moves: errors beside the Cramér-Rao bound, and times.

    python -m benchmarks.motion [--sections NAME ...] [--only TEXT] [--clips N] [--draws N]
        [--resume] [--data FOLDER]

`simulated`: tracks with exact truth, of random lenses on random paths; everything is started from nothing.
f is the RMS over the clips of the error of all focal lengths, relative. The lens's error is the RMS
distance of corrected points over the image, without a shift common to all of them, which turns the camera.
The bound of each is what the covariance of the fit says, without what the robust loss loses. A clip
diverged if its focal lengths are off by more than 3 times the bound and 1 %, and the fit says nothing;
silently if the verdict on it is good, too. Doubted are clips whose verdict is not good, refused ones among
them. Errors are those of clips of which the fit does not say that it failed, if there are any.

`real`: focal lengths, principal points and lenses of the shared broadcast clips, every fourth frame; the
camera stands where it stood, and what it looks at wanders over the pitch, as the data does not tell that.
Tracks of points of a stadium, noise 0.5 px, the centre unknown. The pupil is on the axis of rotation, or
before it; and with the pitch's lines in every fifth frame, a point each 20 px, noise 0.5 px. Points and
noise are drawn several times: f and the lens are of the draw in the middle and of the worst, over all
frames, and the error over its standard deviation is the RMS over the draws.

`rendered`: clips of 1080p and 150 frames, rendered from photographs and encoded as H.264, through the
command line alone, `zoomjax calibrate clip.mp4`.

`shots`: clips with a cut, rendered: f of the second shot, fitted by itself and as the command line fits it,
which joins shots of one scene; and by how much the turn across the cut is off.

`lenses`: simulated tracks of clips of several shots of 24 frames (of four, of 12), 1080p, of one camera and
of two in turn: how many `fit_motion` says to have two lenses, on how many the verdict would be good without
that, and the error of f in the shot where it is largest, in the clip in the middle and in the worst one of
which nothing is said. A clip is off if that is beyond 3 standard deviations and 1 %, and silent if its
verdict is good then.

`tracking`: frames a second of `track_video`, and of decoding alone.

`broadcast`: the real frames of a broadcast in the shared data, beside the focal lengths that the pitch
tells; --panorama FILE writes what they look like put together.

`rivals`: OpenCV's and Hugin's own estimates, on the same simulated tracks.

`time`: seconds of fits, tracking apart, and the most memory of a process that reads tracks and fits them.

Results go to benchmarks/results/motion.md and motion.json after each row. With --only, other rows stay.
With --resume, rows go on after the clips and draws that are stored, which are those of the first seeds.
"""

import argparse
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax

from .motion_broadcast import broadcast
from .motion_cameras import real
from .motion_clips import rendered, tracking
from .motion_lenses import two_lenses
from .motion_rivals import rivals
from .motion_shots import shots
from .motion_simulated import Rows, simulated, timed
from .shared import RESULTS as FOLDER
from .shared import machine, machine_line, table, write


class Section(NamedTuple):
    """A table of the page: its title, the heads of its columns, and what each row has in them."""

    title: str
    heads: tuple[str, ...]
    cells: Callable[[dict], list[str]]


def _percent(value: float) -> str:
    return f"{100 * value:.3f}"


def _px(value: float, digits: int = 3) -> str:
    """A length, or a dash where there is none, as of a lens that is not determined."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"


_BESIDE_BOUNDS = ("f, %", "bound", "ratio", "lens, px", "bound", "ratio")


def _beside_bounds(row: dict) -> list[str]:
    """Errors, bounds and ratios; dashes where all fits say that they failed: these mean nothing."""
    if row["told"] == row["clips"]:
        return ["–"] * len(_BESIDE_BOUNDS)
    return [
        *(_percent(row["f"]), _percent(row["f_bound"]), f"{row['f'] / row['f_bound']:.2f}"),
        *(_px(row["lens"]), _px(row["lens_bound"]), _px(row["lens"] / row["lens_bound"], 2)),
    ]


SECTIONS = {
    "simulated": Section(
        "Simulated tracks",
        (*_BESIDE_BOUNDS, "clips", "refused", "doubted", "diverged", "silent"),
        lambda r: [
            *_beside_bounds(r),
            *(str(r["clips"]), str(r["told"]), "–" if r.get("doubted") is None else str(r["doubted"])),
            *(str(r["diverged"]), str(r.get("silent", r["diverged"]))),
        ],
    ),
    "real": Section(
        "Real lenses",
        ("frames", "draws", "f, %", "worst", "its sd", "error over sd", "lens, px", "worst", "refused"),
        lambda r: [
            *(str(r["frames"]), str(r["draws"]), _percent(r["f"]), _percent(r["f_worst"])),
            *(_percent(r["f_bound"]), f"{r['f_ratio']:.2f}"),
            *(f"{r['lens']:.3f}", f"{r['lens_worst']:.3f}", str(r["told"])),
        ],
    ),
    "rendered": Section(
        "Rendered clips",
        ("frames", "f, %", "its sd", "lens, px", "noise, px", "follow, %"),
        lambda r: [
            *(str(r["frames"]), _percent(r["f"]), _percent(r["f_bound"]), f"{r['lens']:.3f}"),
            *(f"{r['noise']:.2f}", f"{100 * r['follow']:.0f}"),
        ],
    ),
    "shots": Section(
        "Shots across a cut",
        ("frames", "joined", "f alone, %", "its sd", "f, %", "its sd", "turn across the cut, °"),
        lambda r: [
            *(str(r["frames"]), "yes" if r["scenes"] == 1 else "no"),
            *(_percent(r["alone_f"]), _percent(r["alone_f_bound"])),
            *(_percent(r["f"]), _percent(r["f_bound"]), _px(r["rotation"])),
        ],
    ),
    "lenses": Section(
        "Shots of one camera and of two",
        ("clips", "off", "told", "else good", "silent", "f, %", "worst not told, %"),
        lambda r: [
            *(str(r[of]) for of in ("clips", "off", "told", "good_without", "silent")),
            *("–" if math.isnan(of) else _percent(of) for of in (r["f"], r["f_untold"])),
        ],
    ),
    "tracking": Section(
        "Tracking",
        ("frames", "seconds", "frames a second", "decoding alone", "tracks", "views"),
        lambda r: [
            *(str(r["frames"]), f"{r['seconds']:.1f}", f"{r['frames'] / r['seconds']:.1f}"),
            *(f"{r['frames'] / r['decoding']:.0f}", f"{r['tracks']:,}", f"{r['views']:,}"),
        ],
    ),
    "broadcast": Section(
        "Frames of a broadcast",
        ("frames", "turned, °", "f, px", "sd", "from the pitch, px", "sd", "frames with it", "in bands, %"),
        lambda r: [
            *(str(r["frames"]), f"{r['turned']:.1f}", f"{r['f']:.0f}", f"{r['f_std']:.0f}"),
            *(f"{r['pitch']:.0f}", f"{r['pitch_std']:.0f}", str(r["pitch_frames"])),
            f"{100 * r['within']:.0f}",
        ],
    ),
    "rivals": Section(
        "Rivals",
        ("f, %", "common factor off, %", "rest, %", "lens, px"),
        lambda r: [_percent(r["f"]), _percent(r["factor"]), _percent(r["rest"]), f"{r['lens']:.3f}"],
    ),
    "time": Section(
        "Time",
        ("first fit, s", "second, s", "GB", "f, %", "bound", "lens, px", "bound", "successful"),
        lambda r: [
            *(f"{r['first']:.1f}", f"{r['second']:.1f}", f"{r['GB']:.1f}"),
            *(_percent(r["f"]), _percent(r["f_bound"]), f"{r['lens']:.3f}", f"{r['lens_bound']:.3f}"),
            "yes" if r["result"] else "no",
        ],
    ),
}
"""By the names of `--sections`, in the order of the page."""


def page(results: dict) -> str:
    """The page that the results make."""
    lines = [
        "# Lens and focal lengths from motion",
        "",
        "`benchmarks/motion.py` says how it is measured.",
        "",
    ]
    for name, section in SECTIONS.items():
        if name in results:
            rows = [[key, *section.cells(row)] for key, row in results[name]["rows"].items()]
            shown = table([section.title.lower(), *section.heads], rows)
            lines += [f"## {section.title}", "", *shown, "", machine_line(results[name]["machine"]), ""]
    return "\n".join(lines)


def _measured(name: str, options: argparse.Namespace, found: dict[str, list[dict]]) -> Rows:
    """The rows of a section, after what was found before."""
    return {
        "simulated": lambda: simulated(options.clips, options.only, found),
        "real": lambda: real(options.data, options.only, options.draws, found),
        "rendered": lambda: rendered(options.only),
        "shots": lambda: shots(options.only),
        "lenses": lambda: two_lenses(options.clips, options.only, found),
        "tracking": lambda: tracking(options.only),
        "broadcast": lambda: broadcast(options.data, options.only, options.panorama),
        "rivals": lambda: rivals(options.only),
        "time": lambda: timed(options.only),
    }[name]()


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = tuple(SECTIONS)
    parser.add_argument("--sections", nargs="+", choices=names, default=list(names))
    parser.add_argument("--only", default="", help="rows whose names have this text")
    parser.add_argument("--clips", type=int, default=20, help="of each kind")
    parser.add_argument("--draws", type=int, default=5, help="of each real clip")
    parser.add_argument("--resume", action="store_true", help="go on after the stored clips and draws")
    parser.add_argument("--data", type=Path, default=os.environ.get("ZOOMJAX_DATA"), help="shared data")
    parser.add_argument("--panorama", type=Path, help="where to write panoramas of the broadcast")
    parser.add_argument("--output", type=Path, default=FOLDER / "motion.md")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    stored = options.output.with_suffix(".json")
    results = json.loads(stored.read_text()) if stored.exists() else {}
    for name in options.sections:
        if name in ("real", "broadcast") and options.data is None:
            parser.error("--data or ZOOMJAX_DATA must name the folder of the shared data")
        kept = results.get(name, {"rows": {}})["rows"] if options.resume else {}
        found = {key: row["found"] for key, row in kept.items() if "found" in row}
        rows = _measured(name, options, found)
        if not (options.only or options.resume):
            results.pop(name, None)
        section = results.setdefault(name, {"rows": {}})
        section["machine"] = machine()
        for key, row in rows:
            section["rows"][key] = row
            print(key, {k: v for k, v in row.items() if k != "found"}, flush=True)
            write(options.output, page(results), results, quiet=True)
    print(page(results))


if __name__ == "__main__":
    main()
