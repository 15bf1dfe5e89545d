"""The fits of a calibration: which lines, model and centre, and then the zoom lens and the frames."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..fit.algebraic import algebraic_zoom
from ..fit.centre import CentreFit, fit_centre
from ..fit.compression import compressed_as_measured
from ..fit.distortion_models import with_distortion_model
from ..fit.frames import fit_frames
from ..fit.image_metric import in_corrected
from ..fit.prepare import ready_model
from ..fit.problem import data_of
from ..fit.result import FrameFits, ZoomFit, failed
from ..fit.robust import reweighted, typical_rms, weights_for_any_centre
from ..fit.straightness import frame_rms
from ..fit.zoom import CentreArgument, about_centre, fit_zoom
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines, compress
from ..lines.free_centre import AnyCentreLines, compress_any_centre
from ..lines.lines import Lines
from ..models.distortion_model import AbstractDistortionModel, AbstractRadial
from ..models.model import Model
from ..models.polynomial import RadialPolynomial
from ..models.zoom import AbstractLinearZoom, AbstractPriorZoom, PolynomialZoom
from ..trust.between import FEWEST_CHECKED
from ..trust.centre_choice import choose_centre
from ..trust.cross_validation import cross_validate_zoom
from ..trust.selection import Selection
from .centre_found import CentreFound
from .model_choice import STRONG, WantedCentre, WantedModel, one_centre

_TURNS = 2
"""How often centre and weights of the lines are found in turn, at most."""


Metric = Callable[[AbstractLines], AbstractLines]
"""`in_image` or `in_corrected`: where distances are measured."""


class Fitted(NamedTuple):
    """The fits of a calibration, and what they are made from.

    Attributes:
        fit: the zoom lens.
        each: the separate fits of the frames, about its centre.
        lines: with their weights, about its centre.
        held: the same, under the radial polynomial for any centre.
        model: its zoom model, not fitted.
        centre: its centre of distortion, and how it was found.
        selection: how the model was chosen; None where it was given.
        one: the fit about one centre, and its lines: the same unless the centre moves along the zoom.
    """

    fit: ZoomFit
    each: FrameFits
    lines: AbstractLines
    held: AbstractLines
    model: Model
    centre: CentreFound
    selection: Selection | None
    one: tuple[ZoomFit, AbstractLines]


def fitted(
    lines: Lines,
    wanted: WantedModel,
    centre: WantedCentre | None,
    *,
    robust: bool,
    metric: Metric,
    stage: Callable[[str], None],
) -> Fitted:
    """The fits of a calibration; see `calibrate`.

    The model is chosen about the given centre, the centre fitted with it, and the model then chosen again:
    mostly it is the same, and one fit, which takes its time to compile, has been enough. Another distortion
    model than the radial polynomial starts from there, and has its own centre and weights of lines.
    """
    wanted.check_centre(centre)
    moves = isinstance(centre, str) and centre == "moving"
    about = None if centre is None else one_centre(centre)
    if moves and np.unique(np.asarray(lines.focal)).size < 2:
        raise ValueError('Argument centre "moving" needs several focal lengths, not one: give "fit".')
    radial = dataclasses.replace(wanted, distortion_model="radial")
    model = radial.base(lines.focal)
    ready_model(lines, model)  # raises if there are too few focal lengths, before any work
    stage("Compressing the lines")
    held = metric(compressed_about(lines, about, radial.most_terms(lines)))
    found = _about_centre(
        held, radial, model, robust, wanted.distortion_model in (None, "radial", "auto"), stage
    )
    if wanted.distortion_model is None and found.fit is None:
        stage("Fitting the zoom model")
        found = found._replace(fit=fit_zoom(found.lines, zoom=found.model, throw=False))
    strong = found.fit is not None and wanted.is_beyond(found.fit)
    if strong or wanted.distortion_model not in (None, "radial"):
        found = _under_distortion_model(metric(_widest(lines)), held, wanted, found, about, robust, stage)
    small, model, fit = found.lines, found.model, found.fit
    if fit is None or failed(fit.result):
        stage("Fitting the zoom model")
        fit = fit_zoom(small, zoom=model)  # or says why not
    held, one, how = found.held, (fit, small), found.centre
    if isinstance(fit.lens.distortion_model, RadialPolynomial) and not _for_any_centre(held):
        placed: Any = about_centre(_widest(lines), about)
        held = metric(compress_any_centre(placed, radial.most_terms(lines)))
        held = held if small.weight is None else held.weighted(small.weight)
    if moves:
        stage("Fitting how the centre moves")
        fit, small, how = _moving(held, model, how, one)
    stage("Fitting each frame separately")
    each = fit_frames(small, terms=model.terms, throw=False)
    return Fitted(fit, each, small, held, model, how, found.selection, one)


def _moving(
    held: AbstractLines, model: Model, centre: CentreFound, still: tuple[ZoomFit, AbstractLines]
) -> tuple[ZoomFit, AbstractLines, CentreFound]:
    """The fit about a centre that moves, if lines left out are no less straight, its lines and centre."""
    if not _for_any_centre(held):
        return *still, centre.still("that is tried under the radial polynomial alone")
    along = choose_centre(held, model, along=PolynomialZoom(degree=1))
    how = centre.moving(choose_centre(held, model), along)
    if how.how != "moving":
        return *still, how
    return along.found.fit, held.about(along.found.centre), how


class _Centred(NamedTuple):
    """Lines about the centre of distortion, and the model.

    Attributes:
        lines, held, model, centre, selection: as of `Fitted`.
        fit: the fit, where there is one.
    """

    lines: AbstractLines
    held: AbstractLines
    model: Model
    centre: CentreFound
    selection: Selection | None
    fit: ZoomFit | None


def _about_centre(
    held: AbstractLines,
    wanted: WantedModel,
    model: Model,
    robust: bool,
    choose: bool,
    stage: Callable[[str], None],
) -> _Centred:
    """Find the centre of distortion, under the radial polynomial, and the model where it is to be chosen.

    The centre is that of the lens, whatever function of the radius describes it.
    """
    small = held.about(held.centre)
    if robust:
        stage("Rejecting lines that are not straight")
        weight = _weights(held, model)
        small, held = small.weighted(weight), held.weighted(weight)
    selection = None
    if choose and wanted.automatic:
        stage("Choosing the model")
        selection = wanted.choose(small)
        model = selection.chosen
    choice = found = None
    if _for_any_centre(held):
        stage("Fitting the centre of distortion")
        choice = choose_centre(held, model)
        found = choice.found if choice.better else None
        if found is not None and selection is not None:
            again = wanted.choose(held.about(found.fit.lens.centre))
            if again.chosen.name != model.name:
                found = fit_centre(held, zoom=again.chosen)
            if found.determined:
                selection, model = again, again.chosen
    how = CentreFound.of(held, choice, found)
    if found is None or not found.determined:
        return _Centred(small, held, model, how, selection, None)
    return _Centred(held.about(found.fit.lens.centre), held, model, how, selection, found.fit)


def _for_any_centre(lines: AbstractLines) -> bool:
    return isinstance(data_of(lines), AnyCentreLines)


def _weights(held: AbstractLines, model: Model) -> np.ndarray:
    """The weights of the lines, about whichever centre keeps more of them, if it may be another."""
    if _for_any_centre(held):
        return np.asarray(weights_for_any_centre(held, model))
    return np.asarray(reweighted(held.about(held.centre), model)[0].weight)


def _under_distortion_model(
    lines: AbstractLines,
    held: AbstractLines,
    wanted: WantedModel,
    found: _Centred,
    centre: CentreArgument | None,
    robust: bool,
    stage: Callable[[str], None],
) -> _Centred:
    """The same under another distortion model, or under the best of them.

    Lines that one model cannot follow may be straight under another: those that either keeps are compared,
    and the model chosen judges them by itself.
    """
    model, selection, whole = found.model, found.selection, lines.about(found.lines.centre)
    centred = isinstance(centre, str) and centre == "fit"
    compares = wanted.distortion_model in (None, "auto")
    first = wanted.base(lines.focal)
    if compares:
        first = dataclasses.replace(first, distortion_model=STRONG)
    stage("Rejecting lines that are not straight" if robust else "Fitting the distortion model")
    how, start = found.centre, _judged(whole, first, robust)
    apart = centred and not np.array_equal(np.asarray(lines.centre), np.asarray(whole.centre))
    others = []
    for place in (whole, lines) if apart else (whole,):
        other, own = _from_corrected(place, first.distortion_model, robust, centred)
        kept = how if place is whole else CentreFound.of(lines, None, None)
        others.append((other, kept if own is None else CentreFound.of(lines, None, own)))
    other, there = min(others, key=lambda of: of[0].spread)
    if moved := other.spread < start.spread:
        whole, how = lines.about(other.lines.centre), there
        again = (_judged(whole, first, robust), _kept_near(whole, other.lines, first, robust))
        start = min(other, *again, key=_spread)
    if compares:
        stage("Choosing the distortion model")
        compared = [v.candidate for v in selection.compared] if selection else [model]
        either = start.lines
        if robust:
            radial = reweighted(held.about(whole.centre), model)[0] if moved else found.lines
            either = either.weighted(np.maximum(np.asarray(either.weight), np.asarray(radial.weight)))
        selection = wanted.choose_distortion_model(either, model, compared)
        model = selection.chosen
        if isinstance(model.distortion_model, RadialPolynomial) and not moved:
            return found._replace(model=model, selection=selection, fit=None)
    else:
        model = first
        if wanted.automatic:
            stage("Choosing the model")
            selection = wanted.choose_zoom(start.lines)
            model = selection.chosen
    if robust:
        stage("Rejecting lines that are not straight")
    best = min(_judged(whole, model, robust), _kept_near(whole, start.lines, model, robust), key=_spread)
    placed, fit = best.lines, None
    if centred and isinstance(model.distortion_model, AbstractRadial):
        stage("Fitting the centre of distortion")
        own, judged = fit_centre(placed, zoom=best.model, throw=False), placed
        if _gains(own) and robust:
            near = best.model.with_zoom(own.fit.lens.zoom)
            judged = _judged(whole.about(own.fit.lens.centre), near, robust, near=True).lines
            if not np.array_equal(np.asarray(judged.weight), np.asarray(placed.weight)):
                own = fit_centre(judged.about(placed.centre), zoom=near, throw=False)
        if _gains(own):
            how, fit = CentreFound.of(lines, None, own), own.fit
            placed = judged.about(own.fit.lens.centre)
    if isinstance(model.distortion_model, RadialPolynomial):
        # Compressed for more coefficients than the model's.
        kept = held if placed.weight is None else held.weighted(placed.weight)
        return _Centred(kept.about(placed.centre), kept, model, how, selection, fit)
    small = _compressed_for(placed, model)
    return _Centred(small, small, model, how, selection, fit)


class _Start(NamedTuple):
    """Where a fit starts.

    Attributes:
        lines: about a centre, with weights.
        model: with parameters.
        spread: what most lines are off straight under it, px.
    """

    lines: AbstractLines
    model: Model
    spread: float


def _spread(start: _Start) -> float:
    return start.spread


def _judged(whole: AbstractLines, model: Model, robust: bool, near: bool = False) -> _Start:
    """The lines with the weights that the model gives them, and what it is then.

    It is found from all lines, or, with `near`, from its parameters.
    """
    small = _compressed_for(whole, model)
    if not robust:
        fit = fit_zoom(small, zoom=model, invertible=False, throw=False)
        return _Start(whole, model.with_zoom(fit.lens.zoom), _or_infinite(fit.rms))
    weighted, model = reweighted(small, model, near=near)
    return _Start(
        whole.weighted(np.asarray(weighted.weight)), model, _or_infinite(typical_rms(small, model))
    )


def _or_infinite(spread: Any) -> float:
    return float(np.nan_to_num(spread, nan=np.inf))


def _kept_near(whole: AbstractLines, kept: AbstractLines, model: Model, robust: bool) -> _Start:
    """The lines as a model judges them that is fitted to those that were kept."""
    fit = fit_zoom(_compressed_for(kept, model), zoom=model, invertible=False, throw=False)
    return _judged(whole, model.with_zoom(fit.lens.zoom), robust, near=True)


def _from_corrected(
    whole: AbstractLines, distortion_model: AbstractDistortionModel, robust: bool, centred: bool
) -> tuple[_Start, CentreFit | None]:
    """The start that one coefficient gives in the corrected image, in the metric of the lines; its centre.

    Distances in the distorted image vanish where a lens stretches a part of it without bound. So beside
    the minimum a valley leads away from it, to centres far off, and lines weighted on the way keep the
    search there. Distances in the corrected image have no such valley, and their minimum is near. With one
    coefficient, a line of 1/f, a lens cannot follow a few photos of things that are not straight.
    """
    degree = min(1, np.unique(np.asarray(whole.focal)).size - 1)
    there, model = in_corrected(whole), Model(PolynomialZoom(degree=degree), 1, distortion_model)
    start, found = _judged(there, model, robust), None
    for _ in range(_TURNS if centred and isinstance(distortion_model, AbstractRadial) else 0):
        own = fit_centre(start.lines, zoom=start.model, throw=False)
        if not _gains(own):
            break
        found, placed = own, there.about(own.fit.lens.centre)
        start = _judged(placed, model.with_zoom(own.fit.lens.zoom), robust, near=True)
    return _judged(whole.about(start.lines.centre), start.model, robust, near=True), found


def _gains(found: CentreFit) -> bool:
    """Whether a centre was found about which lines are straighter: the search may go astray."""
    return bool(found.determined) and float(found.fit.rms) <= float(found.rms_fixed)


def _compressed_for(lines: AbstractLines, model: Model) -> AbstractLines:
    """The lines compressed for a distortion model."""
    return compressed_as_measured(with_distortion_model(lines, model.distortion_model), model.terms)


def _widest(lines: Lines) -> Lines:
    """The lines in the widest numbers."""
    widest = jnp.result_type(float)
    return jax.tree.map(
        lambda a: jnp.asarray(a, widest) if jnp.issubdtype(a.dtype, jnp.floating) else a, lines
    )


def compressed_about(
    lines: Lines, centre: CentreArgument | None, terms: int
) -> CompressedLines | AnyCentreLines:
    """The lines in the widest numbers, compressed about their centre, or for any if it is to be fitted."""
    data = _widest(lines)
    if not (isinstance(centre, str) and centre == "fit"):
        about: Any = about_centre(data, centre)
        return compress(about, terms)
    held = compress_any_centre(data, terms)
    if held.weight is not None:
        return held
    return held.weighted(np.ones(held.frame.shape))  # as where some are left out: one compiled program


def left_out(lines: AbstractLines, model: Model) -> Float[np.ndarray, "frame"]:
    """RMS of each frame under the model of all others, px; NaN where that tells nothing.

    Of two or three frames, a prior would extrapolate from what is left: that says nothing of the lens.
    """
    least = FEWEST_CHECKED if isinstance(model.zoom, AbstractPriorZoom) else 2
    few = len(lines.focal) < least
    return np.full(len(lines.focal), np.nan) if few else np.asarray(cross_validate_zoom(lines, zoom=model))


def algebraic_rms(lines: AbstractLines, model: Model) -> Float[np.ndarray, "frame"] | None:
    """RMS of the frames, px, under the algebraic estimate.

    None for other distortion models than the radial polynomial: estimated to first order, and far off, if
    strong.
    """
    if not isinstance(in_corrected(lines), CompressedLines):
        return None
    assert isinstance(model.zoom, AbstractLinearZoom)  # `WantedModel` has no other
    return np.asarray(frame_rms(lines, algebraic_zoom(lines, zoom=model.zoom, terms=model.terms)))
