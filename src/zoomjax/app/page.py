"""What HTML reports are made with: their templates, embedded plots and pictures, and figures in words.

Pages are self-contained: style, script, plots and pictures are embedded, and nothing is loaded. What they
share is in ``templates/base.html``, their colours are in ``report.css`` beside it, and ``report.js`` draws
their slider. Plots are drawn for a light background; browsers in dark mode invert them.
"""

import base64
import dataclasses
import functools
import io
import json
from typing import Any

import jinja2
import markupsafe
import matplotlib
from matplotlib.figure import Figure

from .._core.text import plain
from .plot import save_plot


@dataclasses.dataclass(frozen=True)
class Run:
    """What was run, for a report.

    Attributes:
        title: what was calibrated, such as the folder's name.
        rows: names and values: command, folder, date, camera.
    """

    title: str = ""
    rows: tuple[tuple[str, str], ...] = ()


def rendered(template: str, **values: Any) -> str:
    """A page from the template of a name."""
    return _templates().get_template(template).render(**values)


@functools.cache
def _templates() -> jinja2.Environment:
    """The Jinja templates. All text is escaped and free of control characters."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("zoomjax.app"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: _shown(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["together"] = lambda text: text.replace(" ", "\u00a0")  # on one line of the page
    return environment


def _shown(text: str) -> str:
    """Text without control characters, except line breaks."""
    return "\n".join(map(plain, text.split("\n")))


def embedded_data(data: dict[str, Any] | None) -> markupsafe.Markup | None:
    """Numbers as JSON within a page: nothing in it can end the script."""
    if data is None:
        return None
    return markupsafe.Markup(
        json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    )


def data_url(content: bytes, kind: str) -> str:
    """A picture as a data URL."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def embedded_plot(
    figure: Figure, label: str, *, class_: str = "box wide plot", kind: str = "svg"
) -> dict[str, str | int]:
    """A plot, embedded as a data URL, with its natural size so that text stays readable."""
    file = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "zoomjax"}):
        save_plot(figure, file, format=kind, metadata={"Date": None} if kind == "svg" else {})
    width, height = (f"{96 * side:.0f}" for side in figure.get_size_inches())
    source = data_url(file.getvalue(), kind.replace("svg", "svg+xml"))
    return {"source": source, "label": label, "class": class_, "width": width, "height": height}


def short(value: float) -> str:
    """Two digits of a length, or all before the decimal point."""
    return f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"


def counted(count: int, noun: str) -> str:
    """A number of things."""
    return f"{count:,} {noun}" + ("" if count == 1 else "s")
