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
from ..fit.family_lines import with_family
from ..fit.frames import fit_frames
from ..fit.image_metric import in_corrected
from ..fit.prepare import ready_model
from ..fit.problem import data_of
from ..fit.result import FrameFits, ZoomFit, failed
from ..fit.robust import reweighted, typical_rms
from ..fit.straightness import frame_rms
from ..fit.zoom import CentreArgument, about_centre, fit_zoom
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines, compress
from ..lines.free_centre import AnyCentreLines, compress_any_centre
from ..lines.lines import Lines
from ..models.family import AbstractFamily, AbstractRadial
from ..models.model import Model
from ..models.polynomial import RadialPolynomial
from ..models.zoom import AbstractLinearZoom, PolynomialZoom
from ..trust.centre_choice import choose_centre
from ..trust.selection import Selection
from .model_choice import STRONG, CentreFound, WantedModel

_TURNS = 2
"""How often centre and weights of the lines are found in turn, at most."""


Metric = Callable[[AbstractLines], AbstractLines]
"""`in_image` or `in_corrected`: where distances are measured."""


class Fitted(NamedTuple):
    """The fits of a calibration, and what they are made from.

    Attributes:
        zoom: the zoom lens.
        each: the separate fits of the frames, about its centre.
        lines: with their weights, about its centre.
        held: the same, under the radial polynomial for any centre.
        model: its zoom model, not fitted.
        centre: its centre of distortion, and how it was found.
        selection: how the model was chosen; None where it was given.
    """

    zoom: ZoomFit
    each: FrameFits
    lines: AbstractLines
    held: AbstractLines
    model: Model
    centre: CentreFound
    selection: Selection | None


def fitted(
    lines: Lines,
    wanted: WantedModel,
    centre: CentreArgument | None,
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
    radial = dataclasses.replace(wanted, family="radial")
    model = radial.base(lines.focal)
    ready_model(lines, model)  # raises if there are too few focal lengths, before any work
    stage("Compressing the lines")
    held = metric(_compressed(lines, centre, radial.most_terms(lines)))
    found = _about_centre(held, radial, model, robust, wanted.family in (None, "radial", "auto"), stage)
    if wanted.family is None and found.zoom is None:
        stage("Fitting the zoom model")
        found = found._replace(zoom=fit_zoom(found.lines, zoom=found.model, throw=False))
    strong = found.zoom is not None and wanted.is_beyond(found.zoom)
    if strong or wanted.family not in (None, "radial"):
        found = _under_family(metric(_widest(lines)), held, wanted, found, centre, robust, stage)
    small, model, zoom = found.lines, found.model, found.zoom
    if zoom is None or failed(zoom.result):
        stage("Fitting the zoom model")
        zoom = fit_zoom(small, zoom=model)  # or says why not
    stage("Fitting each frame separately")
    each = fit_frames(small, terms=model.terms, throw=False)
    held = found.held
    if isinstance(zoom.lens.family, RadialPolynomial) and not _for_any_centre(held):
        about: Any = about_centre(_widest(lines), centre)
        held = metric(compress_any_centre(about, radial.most_terms(lines)))
        held = held if small.weight is None else held.weighted(small.weight)
    return Fitted(zoom, each, small, held, model, found.centre, found.selection)


class _Centred(NamedTuple):
    """Lines about the centre of distortion, and the model.

    Attributes:
        lines, held, model, centre, selection: as of `Fitted`.
        zoom: the fit, where there is one.
    """

    lines: AbstractLines
    held: AbstractLines
    model: Model
    centre: CentreFound
    selection: Selection | None
    zoom: ZoomFit | None


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
    """The weights of the lines about their centre, or about one fitted to them, whichever keeps more.

    About a centre that is far from the lens's, straight lines look bent, the longest ones most.
    """

    def about(centre: Any) -> np.ndarray:
        return np.asarray(reweighted(held.about(centre), model)[0].weight)

    best, tried = about(held.centre), held
    for _ in range(_TURNS if _for_any_centre(held) and not best.all() else 0):
        found = fit_centre(tried, zoom=model, throw=False)
        other = about(found.fit.lens.centre)
        if not found.determined or other.sum() <= best.sum():
            break
        best, tried = other, held.weighted(other)
    return best


def _under_family(
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
    compares = wanted.family in (None, "auto")
    first = wanted.base(lines.focal)
    if compares:
        first = dataclasses.replace(first, family=STRONG)
    stage("Rejecting lines that are not straight" if robust else "Fitting the distortion model")
    how, start = found.centre, _judged(whole, first, robust)
    apart = centred and not np.array_equal(np.asarray(lines.centre), np.asarray(whole.centre))
    others = []
    for place in (whole, lines) if apart else (whole,):
        other, own = _from_corrected(place, first.family, robust, centred)
        kept = how if place is whole else CentreFound.of(lines, None, None)
        others.append((other, kept if own is None else CentreFound.of(lines, None, own)))
    other, there = min(others, key=lambda of: of[0].spread)
    if moved := other.spread < start.spread:
        whole, how = lines.about(other.lines.centre), there
        again = (_judged(whole, first, robust), _kept_near(whole, other.lines, first, robust))
        start = min(other, *again, key=_spread)
    if compares:
        stage("Choosing the distortion model")
        compared = [v.candidate for v in selection.verdicts] if selection else [model]
        either = start.lines
        if robust:
            radial = reweighted(held.about(whole.centre), model)[0] if moved else found.lines
            either = either.weighted(np.maximum(np.asarray(either.weight), np.asarray(radial.weight)))
        selection = wanted.choose_family(either, model, compared)
        model = selection.chosen
        if isinstance(model.family, RadialPolynomial) and not moved:
            return found._replace(model=model, selection=selection, zoom=None)
    else:
        model = first
        if wanted.automatic:
            stage("Choosing the model")
            selection = wanted.choose_in_family(start.lines)
            model = selection.chosen
    if robust:
        stage("Rejecting lines that are not straight")
    best = min(_judged(whole, model, robust), _kept_near(whole, start.lines, model, robust), key=_spread)
    placed, zoom = best.lines, None
    if centred and isinstance(model.family, AbstractRadial):
        stage("Fitting the centre of distortion")
        own, judged = fit_centre(placed, zoom=best.model, throw=False), placed
        if _gains(own) and robust:
            near = best.model.with_zoom(own.fit.lens.zoom)
            judged = _judged(whole.about(own.fit.lens.centre), near, robust, near=True).lines
            if not np.array_equal(np.asarray(judged.weight), np.asarray(placed.weight)):
                own = fit_centre(judged.about(placed.centre), zoom=near, throw=False)
        if _gains(own):
            how, zoom = CentreFound.of(lines, None, own), own.fit
            placed = judged.about(own.fit.lens.centre)
    if isinstance(model.family, RadialPolynomial):  # compressed for more coefficients than the model's
        kept = held if placed.weight is None else held.weighted(placed.weight)
        return _Centred(kept.about(placed.centre), kept, model, how, selection, zoom)
    small = _in_family(placed, model)
    return _Centred(small, small, model, how, selection, zoom)


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
    small = _in_family(whole, model)
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
    fit = fit_zoom(_in_family(kept, model), zoom=model, invertible=False, throw=False)
    return _judged(whole, model.with_zoom(fit.lens.zoom), robust, near=True)


def _from_corrected(
    whole: AbstractLines, family: AbstractFamily, robust: bool, centred: bool
) -> tuple[_Start, CentreFit | None]:
    """The start that one coefficient gives in the corrected image, in the metric of the lines; its centre.

    Distances in the distorted image vanish where a lens stretches a part of it without bound. So beside
    the minimum a valley leads away from it, to centres far off, and lines weighted on the way keep the
    search there. Distances in the corrected image have no such valley, and their minimum is near. With one
    coefficient, a line of 1/f, a lens cannot follow a few photos of things that are not straight.
    """
    degree = min(1, np.unique(np.asarray(whole.focal)).size - 1)
    there, model = in_corrected(whole), Model(PolynomialZoom(degree=degree), 1, family)
    start, found = _judged(there, model, robust), None
    for _ in range(_TURNS if centred and isinstance(family, AbstractRadial) else 0):
        own = fit_centre(start.lines, zoom=start.model, throw=False)
        if not _gains(own):
            break
        found, placed = own, there.about(own.fit.lens.centre)
        start = _judged(placed, model.with_zoom(own.fit.lens.zoom), robust, near=True)
    return _judged(whole.about(start.lines.centre), start.model, robust, near=True), found


def _gains(found: CentreFit) -> bool:
    """Whether a centre was found about which lines are straighter: the search may go astray."""
    return bool(found.determined) and float(found.fit.rms) <= float(found.rms_fixed)


def _in_family(lines: AbstractLines, model: Model) -> AbstractLines:
    """The lines compressed for a distortion model."""
    return compressed_as_measured(with_family(lines, model.family), model.terms)


def _widest(lines: Lines) -> Lines:
    """The lines in the widest numbers."""
    widest = jnp.result_type(float)
    return jax.tree.map(
        lambda a: jnp.asarray(a, widest) if jnp.issubdtype(a.dtype, jnp.floating) else a, lines
    )


def _compressed(
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


def algebraic_rms(lines: AbstractLines, model: Model) -> Float[np.ndarray, "frame"] | None:
    """RMS of the frames, px, under the algebraic estimate.

    None for other distortion models than the radial polynomial: estimated to first order, and far off, if
    strong.
    """
    if not isinstance(in_corrected(lines), CompressedLines):
        return None
    assert isinstance(model.zoom, AbstractLinearZoom)  # `WantedModel` has no other
    return np.asarray(frame_rms(lines, algebraic_zoom(lines, zoom=model.zoom, terms=model.terms)))
