"""The fits of a calibration: which lines, model and centre, and then the zoom lens and the frames."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..fit.centre import fit_centre
from ..fit.family_lines import compress_family
from ..fit.frames import fit_frames
from ..fit.prepare import ready_model
from ..fit.result import FrameFits, ZoomFit
from ..fit.robust import reweighted
from ..fit.zoom import CentreArgument, about_centre, fit_zoom
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines, compress
from ..lines.free_centre import AnyCentreLines, compress_any_centre
from ..lines.lines import Lines
from ..models.model import Model
from ..models.polynomial import RadialPolynomial
from ..trust.centre_choice import choose_centre
from ..trust.selection import Selection
from .model_choice import CentreFound, WantedModel


class Fitted(NamedTuple):
    """The fits of a calibration, and what they are made from.

    Attributes:
        zoom: the zoom lens.
        each: the separate fits of the frames, about its centre.
        lines: with their weights, about its centre.
        model: its zoom model, not fitted.
        centre: its centre of distortion, and how it was found.
        selection: how the model was chosen; None where it was given.
    """

    zoom: ZoomFit
    each: FrameFits
    lines: AbstractLines
    model: Model
    centre: CentreFound
    selection: Selection | None


def fitted(
    lines: Lines,
    wanted: WantedModel,
    centre: CentreArgument | None,
    *,
    robust: bool,
    stage: Callable[[str], None],
) -> Fitted:
    """The fits of a calibration; see `calibrate`.

    The model is chosen about the given centre, the centre fitted with it, and the model then chosen again:
    mostly it is the same, and one fit, which takes its time to compile, has been enough. Another distortion
    model than the radial polynomial is fitted about the centre found with that.
    """
    wanted.check_centre(centre)
    radial = dataclasses.replace(wanted, family="radial")
    model = radial.base(lines.focal)
    ready_model(lines, model)  # raises if there are too few focal lengths, before any work
    found = _about_centre(lines, radial, centre, robust, wanted.family in ("radial", "auto"), stage)
    small: AbstractLines = found.lines
    model, selection, zoom = found.model, found.selection, found.zoom
    if wanted.family != "radial":
        small, model, selection = _under_family(lines, wanted, found, robust, stage)
        zoom = None
    stage("Fitting the zoom model")
    if zoom is None:
        zoom = fit_zoom(small, zoom=model)
    stage("Fitting each frame separately")
    each = fit_frames(small, terms=model.terms, throw=False)
    return Fitted(zoom, each, small, model, found.centre, selection)


class _Centred(NamedTuple):
    """Lines about the centre of distortion, and the model under the radial polynomial.

    Attributes:
        lines, model, centre, selection: as of `Fitted`.
        zoom: the fit, where the centre was fitted with it.
    """

    lines: CompressedLines
    model: Model
    centre: CentreFound
    selection: Selection | None
    zoom: ZoomFit | None


def _about_centre(
    lines: Lines,
    wanted: WantedModel,
    centre: CentreArgument | None,
    robust: bool,
    choose: bool,
    stage: Callable[[str], None],
) -> _Centred:
    """Find the centre of distortion, under the radial polynomial, and the model where it is to be chosen.

    The centre is that of the lens, whatever function of the radius describes it.
    """
    model, choose = wanted.base(lines.focal), choose and wanted.automatic
    stage("Compressing the lines")
    held = _compressed(lines, centre, wanted.most_terms(lines))
    small = held.about(held.centre)
    if robust:
        stage("Rejecting lines that are not straight")
        small = reweighted(small, model)[0]
        held = held.weighted(np.asarray(small.weight))
    selection = None
    if choose:
        stage("Choosing the model")
        selection = wanted.choose(small)
        model = selection.chosen
    choice = found = None
    if isinstance(held, AnyCentreLines):
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
        return _Centred(small, model, how, selection, None)
    return _Centred(held.about(found.fit.lens.centre), model, how, selection, found.fit)


def _under_family(
    lines: Lines, wanted: WantedModel, found: _Centred, robust: bool, stage: Callable[[str], None]
) -> tuple[AbstractLines, Model, Selection | None]:
    """The lines, the model and its choice under another distortion model, or the best of all of them.

    About the centre that was found. Weights are those under the distortion model itself where it is given:
    lines that one zoom model cannot follow may be straight under another, so that they are judged again by
    the one chosen.
    """
    model, selection = found.model, found.selection
    placed = _widest(lines).about(found.lines.centre)
    if wanted.family == "auto":
        stage("Choosing the distortion model")
        if found.lines.weight is not None:
            placed = placed.weighted(np.asarray(found.lines.weight))
        compared = [v.candidate for v in selection.verdicts] if selection else [model]
        selection = wanted.choose_family(placed, model, compared)
        model = selection.chosen
    else:
        whole, model = placed, wanted.base(lines.focal)
        if robust:
            stage("Rejecting lines that are not straight")
            placed = _straight(whole, model)
        if wanted.automatic:
            stage("Choosing the model")
            selection = wanted.choose_in_family(placed)
            if robust and selection.chosen.name != model.name:
                stage("Rejecting lines that are not straight")
                placed = _straight(whole, selection.chosen)
            model = selection.chosen
    if isinstance(model.family, RadialPolynomial):
        return found.lines, model, selection
    return compress_family(placed, model.family, terms=model.terms), model, selection


def _straight(lines: Lines, model: Model) -> Lines:
    """The lines with the weights that the model gives them."""
    form = compress_family(lines, model.family, terms=model.terms)
    return lines.weighted(np.asarray(reweighted(form, model)[0].weight))


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
