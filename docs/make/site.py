"""The documentation as a folder of pages that opens offline: ``python -m docs.make site [-o FOLDER]``.

Pages keep their places in the repository, so that links between them hold: README.md is the front page,
notebooks become pages with the outputs stored in them (CI runs the notebooks), and each room of the package
has a page of its public names. Zensical then builds them, and stops at a link that leads nowhere.
"""

import importlib
import inspect
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType

from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[2]

ROOMS = (
    "models",
    "lines",
    "tracks",
    "fit",
    "trust",
    "correct",
    "interop",
    "detect",
    "focal",
    "io",
    "scenes",
    "app",
)
"""In the order in which a reader meets them."""


def build(output: Path) -> Path:
    """Build the site into a folder, which is replaced; return its front page."""
    if output.exists() and any(output.iterdir()) and not (output / "sitemap.xml").exists():
        raise SystemExit(f"{output} is no site that was built before: choose another folder with -o.")
    with tempfile.TemporaryDirectory(prefix="zoomjax-site-") as folder:
        work = Path(folder)
        gather(work)
        command = [sys.executable, "-m", "zensical", "build", "--strict"]
        done = subprocess.run(command, cwd=work, capture_output=True, text=True, check=False)
        if done.returncode:
            told = re.sub(r"\x1b\[[\d;]*m", "", done.stdout + done.stderr)  # colours
            raise SystemExit(f"zensical did not build the site:\n{told}")
        shutil.rmtree(output, ignore_errors=True)
        output.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(work / "site", output)
    return output / "index.html"


def gather(work: Path) -> None:
    """Lay all pages, the configuration and the source into a folder."""
    pages = work / "pages"
    shutil.copytree(
        ROOT / "docs", pages / "docs", ignore=lambda folder, names: {"make", *_of(names, ".py", ".toml")}
    )
    shutil.copytree(
        ROOT / "benchmarks" / "results",
        pages / "benchmarks" / "results",
        ignore=lambda folder, names: _of(names, ".json"),
    )
    for name in ("CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff"):
        shutil.copy(ROOT / name, pages / name)
    shutil.copy(ROOT / "README.md", pages / "index.md")
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        _tutorial(notebook, pages / "notebooks")
    for name, text in api_pages().items():
        _write(pages / "api" / name, text)
    for name in ("iframe-worker.js", "tables.css"):
        _write(pages / "assets" / name, (Path(__file__).parent / name).read_text())
    for page in pages.rglob("*.md"):
        page.write_text(linked(page.read_text()))
    shutil.copy(ROOT / "zensical.toml", work / "zensical.toml")
    shutil.copy(Path(__file__).parent / "griffe_docstrings.py", work / "griffe_docstrings.py")
    (work / "src").symlink_to(ROOT / "src")


def linked(text: str) -> str:
    """Links to notebooks and to the README lead to their pages."""
    text = re.sub(r"\]\(([^)\s]*)\.ipynb(#[^)]*)?\)", r"](\1.md\2)", text)
    return re.sub(r"\]\(((?:\.\./)*)README\.md(#[^)]*)?\)", r"](\1index.md\2)", text)


def api_pages() -> dict[str, str]:
    """A page a room: a table of its public names, then each with shapes, units and errors."""
    doors = {room: importlib.import_module(f"zoomjax.{room}") for room in ROOMS}
    rows = [f"| [`zj.{room}`]({room}.md) | {_summary(door)} |" for room, door in doors.items()]
    front = importlib.import_module("zoomjax")
    home = {name: room for room, door in doors.items() for name in door.__all__}
    own = [f"[`{name}`][zoomjax.{home[name]}.{name}]" for name in front.__all__]
    index = [
        "# API",
        "The names that every user needs are in the package itself, `import zoomjax as zj`:",
        ", ".join(own) + ".",
        "All others are in its rooms:",
        "\n".join(["| | |", "|---|---|", *rows]),
    ]
    return {"index.md": "\n\n".join(index) + "\n"} | {
        f"{room}.md": _room_page(room, door) for room, door in doors.items()
    }


def _room_page(room: str, door: ModuleType) -> str:
    full = {name: f"zoomjax.{room}.{name}" for name in door.__all__}
    rows = [f"| [`{name}`][{path}] | {_summary(getattr(door, name))} |" for name, path in full.items()]
    text = [f"# zj.{room}", _summary(door), "\n".join(["| | |", "|---|---|", *rows])]
    return "\n\n".join([*text, *(f"::: {path}" for path in full.values())]) + "\n"


def _summary(thing: object) -> str:
    """The first sentence of a docstring, on one line and safe in a table."""
    documented = inspect.ismodule(thing) or callable(thing)
    text = (inspect.getdoc(thing) or "") if documented else ""
    return " ".join(text.partition("\n\n")[0].split()).replace("|", "\\|")


def _tutorial(notebook: Path, folder: Path) -> None:
    """A notebook as a page, its pictures in a folder beside it."""
    text, resources = MarkdownExporter().from_filename(str(notebook))
    pictures = f"{notebook.stem}_files"
    for name, content in resources["outputs"].items():
        path = folder / pictures / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        text = text.replace(f"]({name})", f"]({pictures}/{name})")
    _write(folder / f"{notebook.stem}.md", text)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def _of(names: list[str], *endings: str) -> set[str]:
    return {name for name in names if name.endswith(endings) or name == "__pycache__"}
