"""The fits of a calibration: which lines, model and centre, and then the zoom lens and the frames."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..fit.centre import fit_centre
from ..fit.frames import fit_frames
from ..fit.result import FrameFits, ZoomFit
from ..fit.robust import reweighted
from ..fit.zoom import CentreArgument, about_centre, fit_zoom
from ..lines.compressed import CompressedLines, compress
from ..lines.free_centre import AnyCentreLines, compress_any_centre
from ..lines.lines import Lines
from ..trust.centre_choice import choose_centre
from ..trust.selection import Candidate, Selection
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
    lines: CompressedLines
    model: Candidate
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
    mostly it is the same, and one fit, which takes its time to compile, has been enough.
    """
    model = wanted.base(lines.focal)
    model.zoom.prepare(
        lines.focal, model.terms
    )  # raises if there are too few focal lengths, before any work
    stage("Compressing the lines")
    held = _compressed(lines, centre, wanted.most_terms(lines))
    small = held.about(held.centre)
    if robust:
        stage("Rejecting lines that are not straight")
        small = reweighted(small, model.zoom, model.terms)[0]
        held = held.weighted(np.asarray(small.weight))
    selection = None
    if wanted.automatic:
        stage("Choosing the model")
        selection = wanted.choose(small)
        model = selection.chosen
    choice = found = None
    if isinstance(held, AnyCentreLines):
        stage("Fitting the centre of distortion")
        choice = choose_centre(held, zoom=model.zoom, terms=model.terms)
        found = choice.found if choice.better else None
        if found is not None and selection is not None:
            again = wanted.choose(held.about(found.fit.lens.centre))
            if again.chosen.name != model.name:
                found = fit_centre(held, zoom=again.chosen.zoom, terms=again.chosen.terms)
            if found.determined:
                selection, model = again, again.chosen
    stage("Fitting the zoom model")
    if found is not None and found.determined:
        zoom = found.fit
        small = held.about(zoom.lens.centre)
    else:
        zoom = fit_zoom(small, zoom=model.zoom, terms=model.terms)
    stage("Fitting each frame separately")
    each = fit_frames(small, terms=model.terms, throw=False)
    return Fitted(zoom, each, small, model, CentreFound.of(held, choice, found), selection)


def _compressed(
    lines: Lines, centre: CentreArgument | None, terms: int
) -> CompressedLines | AnyCentreLines:
    """The lines in the widest numbers, compressed about their centre, or for any if it is to be fitted."""
    widest = jnp.result_type(float)
    data = jax.tree.map(
        lambda a: jnp.asarray(a, widest) if jnp.issubdtype(a.dtype, jnp.floating) else a, lines
    )
    if not (isinstance(centre, str) and centre == "fit"):
        about: Any = about_centre(data, centre)
        return compress(about, terms)
    held = compress_any_centre(data, terms)
    if held.weight is not None:
        return held
    return held.weighted(np.ones(held.frame.shape))  # as where some are left out: one compiled program
