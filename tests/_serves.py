"""Which function serves which model: the table in docs/formulation.md, and how each cell is tried.

`python -m tests._serves` writes it into the page. A cell is what the code says without being run: whether
`requirements` refuse the model, or the function's own annotation of its argument `zoom` does.
tests/test_serves.py tries every cell.
"""

import functools
import inspect
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax import interop, scenes
from zoomjax.fit import _motion_problem, boards, motion
from zoomjax.models import requirements

from . import test_models as models
from .test_models import FOCAL, ROWS, SEEN, SIZE

PAGE = Path(__file__).parents[1] / "docs" / "formulation.md"
BEGIN, END = "<!-- made by tests/_serves.py: begin -->\n", "\n<!-- end -->"

COLUMNS = {
    **{
        name: f"`{name}`" for name in ROWS if name not in ("RadialPolynomial", "LogZoom", "half-polynomial")
    },
    "LogZoom": "own zoom model",
    "half-polynomial": "own radial model",
}
"""Models by their names in the table of all models; zoom models are tried with the radial polynomial."""

AT = 30.0


def ready(name):
    return models.ready(name)


def own_lines(name):
    """The lines with their distortion model, not compressed."""
    return zj.fit.with_distortion_model(models.lines_of(name), ROWS[name].distortion)


def traced(function, *trees):
    """The shapes that a function gives, without computing anything."""
    return eqx.filter_eval_shape(function, *trees)


def options(name):
    return {"zoom": ROWS[name].zoom, "terms": ROWS[name].terms, "throw": False}


def fit_zoom(name):
    return traced(lambda lines: zj.fit_zoom(lines, **options(name)), ready(name))


def in_image(name):
    return traced(lambda lines: zj.fit_zoom(zj.fit.in_image(lines), **options(name)), ready(name))


def fit_frames(name):
    return traced(lambda lines: zj.fit_frames(lines, terms=ROWS[name].terms, throw=False), ready(name))


def fit_centre(name):
    def fit(lines):
        return zj.fit.fit_centre(lines, **options(name))

    return traced(fit, own_lines(name))


def algebraic_zoom(name):
    row = ROWS[name]
    return traced(lambda lines: zj.fit.algebraic_zoom(lines, zoom=row.zoom, terms=row.terms), ready(name))


def fit_focal(name):
    row = ROWS[name]
    return traced(
        lambda lines: zj.fit.fit_focal(lines, 0.3, zoom=row.zoom, terms=row.terms, throw=False), ready(name)
    )


def with_focal_sigma(name):
    return traced(
        lambda fit, lines: zj.fit.with_focal_sigma(fit, lines, focal_sigma=0.3), fit_zoom(name), ready(name)
    )


def reject_points(name):
    row = ROWS[name]
    return zj.fit.reject_points(
        models.lines_of(name), zoom=row.zoom, distortion_model=row.distortion, terms=row.terms, throw=False
    )


def bands(name):
    focus = (0.5,) * bool(models.focus_of(ROWS[name]))
    return traced(
        lambda fit: zj.trust.std_of(fit, lambda lens: lens(AT, *focus).undistort(SEEN)), fit_zoom(name)
    )


def cramer_rao(name):
    return zj.trust.cramer_rao(models.lens_of(name), models.lines_of(name), std=0.1)


def with_misfit(name):
    return zj.trust.with_misfit(models.fit_of(name), ready(name))


def suggest_next(name):
    return zj.suggest_next(models.fit_of(name), ready(name))


@functools.cache
def tracks():
    """Two tracks in as many frames as there are photos."""
    track, frame = np.divmod(np.arange(2 * len(FOCAL)), len(FOCAL))
    points = 100 + 50.0 * track[:, None] + np.stack([frame, 2 * frame], axis=1)
    return zj.tracks.Tracks.from_arrays(track, frame, points, image_size=SIZE)


class Accepted(Exception):
    """The arguments were looked at, and nothing is wrong with them."""


def fit_motion(name):
    """As far as its arguments are looked at: it takes any model that it has accepted."""
    row = ROWS[name]
    try:
        with mock.patch.object(motion, "_fitted", side_effect=Accepted):
            return zj.fit.fit_motion(
                tracks(), zoom=row.zoom, distortion_model=row.distortion, terms=row.terms
            )
    except Accepted:
        return "accepted"


@functools.cache
def any_centre_lines():
    return zj.lines.compress_any_centre(models.lines_of("PolynomialZoom"), 8)


def fit_motion_with_lines(name):
    fit_motion(name)
    row = ROWS[name]
    given = motion.Given(tracks(), any_centre_lines(), None, None, None)
    size = row.distortion.num_coefficients(row.terms)
    return _motion_problem._ready_lines(given, given.tracks.frames, row.distortion, size)


def fit_boards(name):
    """As far as its arguments are looked at: it takes any model that it has accepted."""
    row, places = ROWS[name], np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1)
    grids = [100 + 50 * places] * len(FOCAL)
    options = {"zoom": row.zoom, "distortion_model": row.distortion, "terms": row.terms}
    try:
        with mock.patch.object(boards, "coefficients_of", side_effect=Accepted):
            return zj.fit.fit_boards(grids, FOCAL, image_size=SIZE, **options)
    except Accepted:
        return "accepted"


def one_lens(name):
    """The lens; of a model that depends on the focus, at one."""
    lens = models.lens_of(name)
    return lens.at_focus(0.5) if models.focus_of(ROWS[name]) else lens


def camera(name):
    own = zj.Camera(one_lens(name), pixel_pitch=0.02)
    return own.project(jnp.array([[0.1, 0.2, 5.0]]), AT)


def write(name):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera.yaml"
        return interop.write(models.lens_of(name), path, format="opencv", focal=AT, pixel_pitch=0.02)


def board_photo(name):
    return scenes.board_photo(models.lens_of(name), AT)


class Try(NamedTuple):
    """A row: what it is called, how a model is tried, and what the code says of models.

    Attributes:
        label: in the table.
        function: from the name of a model to anything; raises where the model is refused. Or the name of
            the test in test_models.py that takes all models through it.
        uses: its entries among the requirements; none if it serves all.
        linear: a public function whose argument `zoom` may be annotated with a kind of zoom model.
    """

    label: str
    function: Callable[[str], Any] | str
    uses: tuple[str, ...] = ()
    linear: Callable[..., Any] | None = None


TRIES = (
    Try("`fit_zoom`, covariance", "test_fit_and_covariance"),
    Try("Sampson metric (`in_image`)", in_image),
    Try("`fit_frames`", fit_frames),
    Try("`fit_robust`", "test_robust_fit"),
    Try("`reject_points`", reject_points),
    Try("`fit_centre`", fit_centre, ("fit_centre",)),
    Try("`algebraic_zoom`", algebraic_zoom, linear=zj.fit.algebraic_zoom),
    Try("`fit_focal`", fit_focal),
    Try("`with_focal_sigma`", with_focal_sigma),
    Try("`fit_motion`", fit_motion, ("fit_motion",)),
    Try("`fit_motion` with lines", fit_motion_with_lines, ("fit_motion", "fit_motion with lines")),
    Try("`fit_boards`", fit_boards, ("fit_boards",)),
    Try("bands (`std_of`)", bands),
    Try("`with_misfit`", with_misfit, ("with_misfit",)),
    Try("`cramer_rao`", cramer_rao, ("cramer_rao",)),
    Try("cross-validation, `select_model`", "test_cross_validation"),
    Try("`suggest_next`", suggest_next, ("suggest_next",)),
    Try("certificate (`certify`)", "test_certificate"),
    Try("`lens.json`", "test_save_and_load"),
    Try("`undistort_image`", "test_image_correction"),
    Try("`Camera`", camera),
    Try("`interop.write`", write, ("interop.write",)),
    Try("`scenes.board_photo`", board_photo, ("board_photo",)),
)

KINDS = ("PolynomialZoom", "PowerZoom", "SmoothZoom", "FocusSplineZoom", "Division", "BrownConrady")
"""One model of each kind: linear, not linear, with a prior, of the focus; radial, and not."""


def refused(row: Try, name: str) -> bool:
    """Whether the code says that the model is not served."""
    parts = {"zoom": ROWS[name].zoom, "distortion_model": ROWS[name].distortion, "shift": None}
    for use in row.uses:
        asked = requirements.REQUIREMENTS[use]
        if requirements.refusal(use, **{part: parts[part] for part in asked}):
            return True
    if row.linear is None:
        return False
    kind = inspect.signature(row.linear).parameters["zoom"].annotation
    return not isinstance(parts["zoom"], kind)


def table() -> str:
    """The table in Markdown."""
    head = ["", *COLUMNS.values()]
    rows = [["---"] * len(head)]
    for row in TRIES:
        rows.append([row.label, *("–" if refused(row, name) else "✓" for name in COLUMNS)])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [head, *rows])


def main() -> None:
    """Write the table into the page."""
    text = PAGE.read_text()
    before, rest = text.split(BEGIN)
    PAGE.write_text(before + BEGIN + table() + END + rest.split(END, 1)[1])


if __name__ == "__main__":
    main()
