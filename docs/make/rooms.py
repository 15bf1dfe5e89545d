"""The picture of the rooms, from the imports in their code: ``python -m docs.make rooms``.

A room stands above all rooms that it imports. Arrows that longer ways stand for are left out, so that all
imports follow arrows.
"""

import ast
import functools
import importlib
import inspect
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "zoomjax"
PICTURE = ROOT / "docs" / "figures" / "rooms.svg"

WIDTH, HEIGHT, ACROSS, DOWN, GAP = 190, 56, 220, 96, 12
"""Of a room, from one to the next, and around them all, px."""

COLUMNS = {
    "app": (0, 3),
    "trust": (2, 2),
    "fit": (2, 2),
    "scenes": (3, 3),
    "correct": (1, 1),
    "lines": (2, 2),
    "detect": (0, 0),
    "models": (2, 2),
    "focal": (3, 3),
    "io": (0, 1),
    "_core": (2, 3),
}
"""The first and last column of each room, so that no arrow runs behind another room."""

STYLE = """
  .room rect { fill: #f5f7fa; stroke: #1e3a5f; }
  .room text { font: 11px sans-serif; fill: #475569; text-anchor: middle; }
  .room .name { font: bold 15px sans-serif; fill: #1e3a5f; }
  .arrow { fill: none; stroke: #c2410c; stroke-width: 1.3; marker-end: url(#head); }
"""

ABOUT = {
    "app": "command line, report, plots",
    "trust": "bands, cross-validation",
    "fit": "energies and minimisers",
    "scenes": "scenes with exact truth",
    "correct": "points, images, video",
    "lines": "lines and compression",
    "tracks": "points followed in clips",
    "detect": "images to lines",
    "focal": "focal lengths from planes",
    "interop": "lenses of other tools",
    "models": "distortion and zoom models",
    "io": "EXIF, tables, video",
    "_core": "types, checks, files",
}
"""What fits into a box; rooms that are not here are drawn by their name alone."""


def update() -> list[Path]:
    """Draw the picture again; return its path."""
    PICTURE.write_text(svg(imports()))
    return [PICTURE]


def imports() -> dict[str, set[str]]:
    """The rooms, and which other rooms the modules of each import."""
    rooms = sorted(path.name for path in SOURCE.iterdir() if (path / "__init__.py").exists())
    return {room: _imported(room) & set(rooms) - {room} for room in rooms}


def _imported(room: str) -> set[str]:
    found = set()
    for path in (SOURCE / room).rglob("*.py"):
        package = ["zoomjax", *path.relative_to(SOURCE).parts[:-1]]
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                base = package[: len(package) - node.level + 1] if node.level else []
                origin = [*base, *(node.module or "").split(".")] if node.module else base
                names = [origin] if len(origin) > 1 else [[*origin, alias.name] for alias in node.names]
                found |= {name[1] for name in names if name[0] == "zoomjax" and len(name) > 1}
            elif isinstance(node, ast.Import):
                names = [alias.name.split(".") for alias in node.names]
                found |= {name[1] for name in names if name[0] == "zoomjax" and len(name) > 1}
    return found


def floors(arrows: Mapping[str, set[str]]) -> dict[str, int]:
    """How many rooms the longest way down from each room passes."""

    @functools.cache
    def floor(room: str) -> int:
        return 1 + max((floor(other) for other in arrows[room]), default=-1)

    return {room: floor(room) for room in arrows}


def direct(arrows: Mapping[str, set[str]]) -> dict[str, list[str]]:
    """The arrows that no longer way stands for."""

    @functools.cache
    def below(room: str) -> frozenset[str]:
        return frozenset().union(*({other} | below(other) for other in arrows[room]))

    return {room: sorted(rooms - set().union(*map(below, rooms))) for room, rooms in arrows.items()}


def svg(arrows: Mapping[str, set[str]]) -> str:
    """The picture."""
    boxes = places(arrows)
    wide = max(box.right for box in boxes.values()) + GAP
    high = max(box.top for box in boxes.values()) + HEIGHT + GAP
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {high}" role="img">',
        "<title>The rooms of zoomjax and which imports which</title>",
        f"<style>{STYLE}</style>",
        '<defs><marker id="head" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" '
        'orient="auto"><path d="M0 0L8 4L0 8z" fill="#c2410c"/></marker></defs>',
        *(_arrow(room, other, boxes) for room, others in direct(arrows).items() for other in others),
        *(_drawn(room, box) for room, box in boxes.items()),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


class Box(NamedTuple):
    """Where a room is drawn, px."""

    left: int
    top: int
    right: int


def places(arrows: Mapping[str, set[str]]) -> dict[str, Box]:
    """A row for each floor; in it the columns that are set, and for other rooms the next that are free."""
    floor = floors(arrows)
    boxes = {}
    for room in sorted(arrows, key=lambda room: (room not in COLUMNS, room)):
        top = GAP + DOWN * (max(floor.values()) - floor[room])
        taken = [box for box in boxes.values() if box.top == top]
        first, last = COLUMNS.get(room) or _free(taken)
        boxes[room] = Box(GAP + ACROSS * first, top, GAP + ACROSS * last + WIDTH)
    return boxes


def _free(taken: list[Box]) -> tuple[int, int]:
    column = next(
        n for n in range(99) if all(not box.left <= GAP + ACROSS * n < box.right for box in taken)
    )
    return column, column


def _arrow(room: str, other: str, boxes: Mapping[str, Box]) -> str:
    """From the one room down to the other, as straight as the boxes allow."""
    above, below = boxes[room], boxes[other]
    low, high = max(above.left, below.left), min(above.right, below.right)
    if low < high:
        x = to_x = (low + high) // 2
    else:
        x, to_x = (
            _nearest(one, (two.left + two.right) // 2) for one, two in ((above, below), (below, above))
        )
    y, to_y = above.top + HEIGHT, below.top
    turned, bend = y + DOWN - HEIGHT - 9, (DOWN - HEIGHT) // 2  # sideways before the next row begins
    curve = f"C{x} {y + bend} {to_x} {turned - bend} {to_x} {turned}"
    return f'<path class="arrow" data-arrow="{room} {other}" d="M{x} {y}{curve}V{to_y}"/>'


def _nearest(box: Box, x: int) -> int:
    return min(max(x, box.left + WIDTH // 3), box.right - WIDTH // 3)


def _drawn(room: str, box: Box) -> str:
    x, y = (box.left + box.right) // 2, box.top + HEIGHT // 2
    return (
        f'<g class="room" data-room="{room}"><rect x="{box.left}" y="{box.top}" '
        f'width="{box.right - box.left}" height="{HEIGHT}" rx="6"/>'
        f'<text class="name" x="{x}" y="{y - 4}">{room}</text>'
        f'<text x="{x}" y="{y + 15}">{escape(ABOUT.get(room, ""))}</text></g>'
    )


def table() -> str:
    """What each room is for, from its docstring, and what it imports."""
    arrows, floor = imports(), floors(imports())
    rows = ["| room | what is in it | imports |", "|---|---|---|"]
    for room in sorted(arrows, key=lambda room: (-floor[room], room)):
        about = inspect.getdoc(importlib.import_module(f"zoomjax.{room}")) or ""
        others = ", ".join(f"`{other}`" for other in sorted(arrows[room], key=lambda r: (-floor[r], r)))
        rows.append(f"| `{room}` | {about.splitlines()[0]} | {others} |")
    return "\n".join(rows)
