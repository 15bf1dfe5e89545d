"""Lenses of which a few focal lengths are fitted, and priors that know nothing, or the range, of each."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax.models.smooth import facts_of

from .data import QUANTILES, Frames, Lens
from .models import FEW, batches_of, fit_polynomials, inner, interpolate, lens_error, some_of
from .page import FITTED, KNOWN, OURS
from .prior import Prior, facts_of_all, few_errors, learn, no_facts

MANY = 7
"""Focal lengths of a lens of which a part is still some."""


class Learned(NamedTuple):
    """Priors of one kind, each learned from the other half of the lenses than the one it is for.

    Attributes:
        facts: what they know of each lens.
        priors: by the half that they are for.
    """

    facts: np.ndarray
    priors: list[Prior]

    def of_lens(self, i: int, side: np.ndarray) -> zj.SmoothZoom:
        """The prior for one lens."""
        return self.priors[side[i]].of(self.facts[i])


def learn_both(lenses: list[Lens], data: list[Frames], side: np.ndarray) -> dict[str, Learned]:
    """The priors that know nothing of a lens, and those that know its range and crop factor.

    What is independent goes side by side: half of the time is compiling, which takes one core.
    """
    facts = {OURS: no_facts(lenses), KNOWN: facts_of_all(lenses)}
    with ThreadPoolExecutor(2) as pool:
        running = {
            name: [pool.submit(learn, data, of, side != part) for part in (0, 1)]
            for name, of in facts.items()
        }
    return {name: Learned(facts[name], [one.result() for one in both]) for name, both in running.items()}


def few_focal_lengths(
    data: list[Frames], side: np.ndarray, learned: dict[str, Learned]
) -> dict[str, dict[str, list[float]]]:
    """Quantiles of the lenses' errors, px, at the interior focal lengths where only a few are fitted."""

    def interpolated(frames: Frames, number: int) -> np.ndarray:
        errors = []
        for one in range(len(frames.focal)):
            lens = Frames(*(np.asarray(values[one]) for values in frames))
            known, there = np.asarray(some_of(lens, number)), lens.second[:, 0, 0] > 0
            k = np.zeros_like(lens.k)
            fitted = Frames(*(values[known] for values in lens))
            k[there] = interpolate(fitted, lens.focal[there], "table in 1/f")
            errors.append(lens_error(lens, jnp.asarray(k), inner(lens) & ~known))
        return np.array(errors)

    def polynomial(frames: Frames, number: int) -> Any:
        seen = jnp.where(some_of(frames, number)[..., None, None], frames.second, 0)
        k = fit_polynomials(frames._replace(second=seen), min(2, number - 1))[0]
        return lens_error(frames, k, inner(frames) & ~some_of(frames, number))

    found: dict[str, dict[str, list[float]]] = {}
    for number in FEW:
        parts: dict[str, list[np.ndarray]] = {}
        for part in (0, 1):
            for members, frames in batches_of(data, np.flatnonzero(side == part)):
                errors = {
                    **{
                        name: few_errors(frames, jnp.asarray(of.facts[members]), number, of.priors[part])
                        for name, of in learned.items()
                    },
                    "polynomial of degree 2, or the highest there is": polynomial(frames, number),
                    "table in 1/f": interpolated(frames, number),
                }
                for name, of in errors.items():
                    parts.setdefault(name, []).append(np.sqrt(np.asarray(of)))
        for name, of in parts.items():
            values = np.concatenate(of)
            found.setdefault(name, {})[str(number)] = np.quantile(values, QUANTILES).tolist()
    return found


def part_of_the_range(
    lenses: list[Lens], data: list[Frames], side: np.ndarray, learned: dict[str, Learned]
) -> dict[str, Any]:
    """The same where only the longer half of the range is photographed.

    A lens is known by its whole range, about its shortest focal length, or taken for one of that half.
    """
    chosen = [i for i, lens in enumerate(data) if len(lens.focal) >= MANY]
    cut = [Frames(*(values[len(data[i].focal) // 2 :] for values in data[i])) for i in chosen]
    pairs = zip(chosen, cut, strict=True)
    halved = np.array([facts_of(of.focal[0], of.focal[-1], lenses[i].crop) for i, of in pairs])
    whole, nothing = learned[KNOWN].facts[chosen], no_facts(cut)
    shortest = np.array([data[i].focal[0] for i in chosen])
    kinds = {
        OURS: (OURS, nothing, None),
        KNOWN: (KNOWN, whole, shortest),
        FITTED: (KNOWN, halved, None),
    }
    found: dict[str, dict[str, list[float]]] = {name: {} for name in kinds}
    for number in FEW[:2]:
        for name, (kind, facts, reference) in kinds.items():
            parts = []
            for part in (0, 1):
                for members, frames in batches_of(cut, np.flatnonzero(side[chosen] == part)):
                    about = None if reference is None else jnp.asarray(reference[members])
                    prior = learned[kind].priors[part]
                    of = few_errors(frames, jnp.asarray(facts[members]), number, prior, about)
                    parts.append(np.sqrt(np.asarray(of)))
            values = np.concatenate(parts)
            found[name][str(number)] = np.nanquantile(values, QUANTILES).tolist()
    return {"lenses": len(cut), "errors": found}
