"""What the studies of real data share: the zoom models compared, choosing frames, intervals, the page.

A study reads its data from the folder that the environment variable ZOOMJAX_DATA names, prints a page of
tables, and writes it to benchmarks/results with the figures beside it as JSON.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import zoomjax as zj

from ..shared import RESULTS, machine, machine_line, real_data, write
from ..shared import table as table

TERMS = 2
NONE, EACH, DEFAULT = "no correction", "each zoom by itself", "zoom polynomial, degree 2"


@dataclass(frozen=True)
class Candidate:
    """A zoom model to compare: how it is specified for some lines, and the number of its coefficients."""

    name: str
    zoom: Callable[[zj.lines.AbstractLines], zj.models.AbstractZoom]
    terms: int = TERMS

    def coefficients(self, lines: zj.lines.AbstractLines, focal: np.ndarray) -> np.ndarray:
        """Of the model fitted to the lines, at some focal lengths: (focal, TERMS), absent ones zero.

        NaN where the solver fails.

        Raises:
            ValueError: the lines cannot determine the model; the message says why.
        """
        fit = zj.fit_zoom(lines, zoom=self.zoom(lines), terms=self.terms, throw=False)
        found = np.asarray(_at(fit.lens.zoom, jnp.asarray(focal)))
        return np.pad(found, ((0, 0), (0, TERMS - self.terms)))


def candidates(entries: int | None = None) -> list[Candidate]:
    """Polynomials, and the rivals that the paper names.

    Args:
        entries: of tables, and knots of splines; None for one at every focal length.
    """

    def always(zoom: zj.models.AbstractZoom) -> Callable[[zj.lines.AbstractLines], zj.models.AbstractZoom]:
        return lambda lines: zoom

    note = "" if entries is None else f", {entries} entries"
    knots = "" if entries is None else f", {entries} knots"
    polynomials = [
        Candidate(f"zoom polynomial, degree {degree}", always(zj.PolynomialZoom(degree=degree)))
        for degree in range(4)
    ]
    return [
        *polynomials,
        Candidate("degree 2, k1 alone", always(zj.PolynomialZoom(degree=2)), 1),
        Candidate(f"table in f{note} [25]", always(zj.models.TableZoom(number=entries, inverse=False))),
        Candidate(f"table in 1/f{note} [25]", always(zj.models.TableZoom(number=entries))),
        Candidate(f"spline in 1/f{knots}", always(zj.models.SplineZoom(number=entries))),
        Candidate("power law, k1 and k2", always(zj.models.PowerZoom())),
        Candidate("power law, k1 alone [14]", always(zj.models.PowerZoom()), 1),
        Candidate("two regions, k1 alone [30]", _two_regions, 1),
    ]


def _two_regions(lines: zj.lines.AbstractLines) -> zj.models.AbstractZoom:
    """Parted where a single quadratic changes its sign: single frames may tell it from their noise."""
    whole = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(degree=2), terms=1).lens.zoom
    crossover = zj.models.barrel_crossover(lines.focal, _at(whole, lines.focal)[:, 0])
    return zj.models.TwoRegionZoom(crossover=jnp.asarray(crossover))


@eqx.filter_jit
def _at(zoom, focal):
    return jax.vmap(zoom)(focal)


def choose(lines: zj.lines.CompressedLines, frames: np.ndarray, room: int) -> zj.lines.CompressedLines:
    """The lines of some frames, which are numbered anew.

    Args:
        lines: of all frames.
        frames: those chosen.
        room: lines that every frame is given, the missing ones empty. Other choices of as many frames then
            have the same shape, and what is compiled for one serves all.
    """
    index, present = (np.asarray(array)[frames] for array in lines.by_frame())
    padding = ((0, 0), (0, room - index.shape[1]))
    index, present = np.pad(index, padding).ravel(), np.pad(present, padding).ravel()
    return zj.lines.CompressedLines(
        triangle=jnp.where(present[:, None, None], lines.triangle[index], 0),
        frame=jnp.asarray(np.repeat(np.arange(len(frames)), room), jnp.int32),
        focal=lines.focal[frames],
        centre=lines.centre,
        image_size=lines.image_size,
        focal_unit=lines.focal_unit,
    )


def fitting(
    lines: zj.lines.AbstractLines, entries: int | None = None
) -> tuple[list[Candidate], dict[str, str]]:
    """The candidates that can be fitted to lines such as these, and why the others cannot."""
    able, unable = [], {}
    for model in candidates(entries):
        try:
            model.coefficients(lines, np.asarray(lines.focal))
            able.append(model)
        except ValueError as error:
            unable[model.name] = str(error)
    return able, unable


def root_mean(squares: np.ndarray, axis: int = -1) -> np.ndarray:
    """The RMS that squared RMS values of frames make together (eq. 13)."""
    return np.sqrt(np.mean(squares, axis=axis))


def interval(samples: np.ndarray) -> list[float]:
    """The middle 95 % of samples."""
    return np.quantile(samples, [0.025, 0.975]).tolist()


def main(
    description: str | None, name: str, run: Callable[[Path], dict], page: Callable[[dict], list[str]]
) -> None:
    """The command line of a study: measure, print, and write the page."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=RESULTS / f"{name}.md")
    output = parser.parse_args().output
    data = real_data(parser)
    jax.config.update("jax_enable_x64", True)
    results = {"machine": machine(), **run(data)}
    results["cpu_seconds"] = time.process_time()
    specification = sys.modules["__main__"].__spec__
    module = specification.name if specification else f"benchmarks.real.{name}"
    write(output, "\n".join(whole_page(results, module, page(results))), results)


def whole_page(results: dict, module: str, lines: list[str]) -> list[str]:
    """The page of a study with the command that makes it, and where it ran."""
    command = f"`python -m {module}`: {results['cpu_seconds']:.0f} s of CPU time."
    return [*lines[:2], command, "", *lines[2:], "", machine_line(results["machine"]), ""]
