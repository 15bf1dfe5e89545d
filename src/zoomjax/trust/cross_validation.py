"""Cross-validation over focal lengths, frames or lines: straightness of lines not used in the fit.

The lines are split into folds. Each fold is left out in turn, with weight 0 for its lines, and measured
with the model fitted to the others. For models that are linear in their parameters see `_linear_folds`;
others are fitted again for each fold.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from .._core.arguments import kinds_checked
from .._core.checks import checked_integer
from .._core.types import of_known_values
from ..fit.compression import compressed_as_measured
from ..fit.energy import line_squares, line_squares_by_frame, settings
from ..fit.frames import fit_frames
from ..fit.image_metric import in_corrected, measured_as
from ..fit.prepare import asked_for
from ..fit.problem import Problem
from ..fit.result import RESULTS
from ..fit.zoom import fit_zoom
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines
from ..models.model import Model
from ..models.zoom import AbstractLinearZoom, AbstractZoom
from ._designs import Design
from ._lanes import Lanes, as_given, lanes_of
from ._linear_folds import cross_validated, linear_errors
from .folds import Folds, HoldOut, LineErrors, folds_of, shares, small_lines


@kinds_checked
@of_known_values
def cross_validate_zoom(
    lines: AbstractLines,
    *,
    zoom: AbstractZoom | Model | None = None,
    terms: int | None = None,
    hold_out: HoldOut = "frame",
    folds: int | None = None,
    seed: int = 0,
) -> Float[np.ndarray, "frame"]:
    """Cross-validated RMS of each frame, px, under zoom models fitted without it.

    By default one frame is left out at a time, and corrected by the model of all others at its focal
    length. For a frame at the shortest or longest focal length the model extrapolates, unless another frame
    has it.

    Args:
        lines: the lines, or, much faster, ``compress(lines)``, either also measured in the image
            (`in_image`); or ``compress_for(lines, distortion_model)``, with a separate fit for each part.
        zoom, terms: as for `fit_zoom`. The model is made ready anew for each part: of a fitted one only the
            settings and the number of coefficients count.
        hold_out, folds, seed: as for `select_model`.

    Returns:
        The root of eq. 3 of each frame, of the lines left out. NaN where the model cannot be fitted to the
        remaining lines, and for frames that are never left out.

    Example:
        >>> from zoomjax import compress, fit_zoom, scenes
        >>> lines = compress(
        ...     scenes.board_lines(
        ...         scenes.nikkor_18_200(), scenes.focal_sweep(5), spacing=200, noise=0.5
        ...     )
        ... )
        >>> bool((cross_validate_zoom(lines) ** 2).mean() > fit_zoom(lines).rms ** 2)
        True
    """
    lines, asked = asked_for(lines, zoom, terms)
    model = asked.with_parameters(None)
    small = _small(lines, model.terms)
    parts = folds_of(small, hold_out, folds, seed)
    found = errors_of(small, model, parts)
    return _by_frame(small, np.where(parts.fold >= 0, found.unseen, np.nan))


@kinds_checked
@of_known_values
def cross_validate_frames(
    lines: AbstractLines, *, terms: int = 2, folds: int | None = None, seed: int = 0
) -> Float[np.ndarray, "frame"]:
    """Cross-validated RMS of each frame, px, under fits of other lines of the same frame.

    It measures how well the separate fit of a frame predicts further lines: the noise, and the error from
    too few lines.

    Args:
        lines, terms: as for `fit_frames`.
        folds: number of parts into which a frame's lines are split; 10 by default.
        seed: random seed of the split.

    Returns:
        The root of eq. 3 of each frame, of all its lines, each as it was left out. NaN for a frame with
        fewer than two lines.
    """
    terms = checked_integer("terms", terms, 1)
    small = _small(lines, terms)
    if not is_compressed(small):
        return _frames_by_fits(small, terms, folds, seed)
    parts = folds_of(small, "line", folds, seed)
    lanes = lanes_of(small, parts.fold, parts.weight, terms)
    unseen = np.full(lanes.fold.shape, np.nan)
    one = Design(np.ones((1, 1)), np.zeros((terms, terms)), np.zeros(terms))
    for frame in np.unique(lanes.frame):
        own = lanes.frame == frame
        alone = Lanes(
            lanes.columns[..., own],
            lanes.gram[..., own],
            np.zeros(own.sum(), int),
            lanes.counts[own],
            lanes.weight[own],
            lanes.fold[own],
            starts=np.zeros(1, int),
            frames=1,
            rounding=lanes.rounding,
            moments=None if lanes.moments is None else lanes.moments[..., own],
        )
        unseen[own] = cross_validated(alone, [[one] * (parts.number + 1)])[0].unseen
    return _by_frame(small, as_given(small, unseen))


def _small(lines, terms):
    """The lines compressed, under their own distortion model and in their own metric."""
    plain = in_corrected(lines)
    wrapped = isinstance(plain, Problem)
    return (
        compressed_as_measured(lines, terms) if wrapped else measured_as(small_lines(plain, terms), lines)
    )


def is_compressed(lines: AbstractLines) -> bool:
    """Whether lines are compressed for the radial polynomial, in whatever metric."""
    return isinstance(in_corrected(lines), CompressedLines)


def errors_of(lines: AbstractLines, model: Model, parts: Folds) -> LineErrors:
    """A model's errors on the lines of the fit, and on lines left out.

    Args:
        lines: from `small_lines`, or those lines with another distortion model or metric.
        model: a model without parameters.
        parts: the folds.
    """
    found = errors_of_models(lines, [model], parts)[0]
    if isinstance(found, str):
        raise ValueError(found)
    return found


def errors_of_models(lines: AbstractLines, models: Sequence[Model], parts: Folds) -> list[LineErrors | str]:
    """The same of several models, or why there are none. Those that are linear are fitted together."""
    compressed = is_compressed(lines)
    linear = [compressed and isinstance(model.zoom, AbstractLinearZoom) for model in models]
    together = iter(linear_errors(lines, list(itertools.compress(models, linear)), parts))
    return [
        next(together) if fast else _errors_or_why(lines, model, parts)
        for model, fast in zip(models, linear, strict=True)
    ]


def _errors_or_why(lines, model, parts):
    try:
        return _errors_by_fits(lines, model, parts)
    except ValueError as error:
        return str(error)


def _by_frame(lines, of_line):
    """Root of the mean over each frame's lines, by their weights; NaN if one that counts is not known."""
    share, frame = shares(lines), np.asarray(lines.frame)
    kept = share > 0
    total, squares = (
        np.bincount(frame[kept], values[kept], minlength=len(lines.focal))
        for values in (share, share * of_line)
    )
    return np.sqrt(squares / np.where(total > 0, total, np.nan))


def _frames_by_fits(lines, terms, folds, seed):
    """`cross_validate_frames` of another distortion model, by fits of all frames for each part of lines."""
    parts = folds_of(lines, "line", folds, seed)
    own = parts.weight
    unseen = np.full(own.shape, np.nan)
    for fold in range(parts.number):
        out = parts.fold == fold
        fits = fit_frames(lines.weighted(own * ~out), terms=terms, invertible=False, throw=False)
        unseen[out] = np.asarray(line_squares_by_frame(lines, fits.coefficients))[out]
    alone = np.bincount(np.asarray(lines.frame)[own > 0], minlength=len(lines.focal)) < 2
    unseen[alone[np.asarray(lines.frame)]] = np.nan
    return _by_frame(lines, unseen)


def _errors_by_fits(lines, model, parts):
    """By a fit of its own for each fold, from that of all lines, unless some of that would stay."""
    everything = fit_zoom(lines, zoom=model, invertible=False, throw=False)
    seen = np.asarray(line_squares(lines, everything.lens.zoom))
    unseen, failed = np.full(seen.shape, np.nan), 0
    problem = ""
    for fold in range(parts.number):
        kept = parts.weight * (parts.fold != fold)
        left = np.unique(np.asarray(lines.frame)[kept > 0])
        try:
            focal, *focus = (np.asarray(values)[left] for values in settings(model.zoom, lines))
            model.zoom.prepare(focal, model.num_coefficients, *focus)
        except ValueError as error:
            problem = problem or str(error)
            continue
        rest = lines.weighted(kept)
        fit = fit_zoom(rest, zoom=everything.lens.zoom, invertible=False, throw=False)
        if fit.result == RESULTS.undetermined:  # where the start stays, which has seen the lines left out
            fit = fit_zoom(rest, zoom=model, invertible=False, throw=False)
        if fit.result in (RESULTS.successful, RESULTS.undetermined, RESULTS.folded):
            out = parts.fold == fold
            unseen[out] = np.asarray(line_squares(lines, fit.lens.zoom))[out]
        else:
            failed += 1
    if failed:
        problem = problem or f"{failed} of {parts.number} folds do not converge"
    return LineErrors(seen, unseen, float(ravel_pytree(everything.lens.zoom.parameters)[0].size), problem)
