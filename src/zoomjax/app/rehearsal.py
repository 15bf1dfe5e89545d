"""What comes last in a first calibration, done by another process while this one does what comes first.

A first calibration compiles for most of its time, on one core. Where no earlier one of such photos was
noted, that process takes the lines as soon as they are known, and does the later steps with the model that
is tried first, a radial polynomial about the centre where the search begins. What it compiles is kept, and
found by this process when it gets there. Mostly that is what it needs; where not, another core and some
hundred megabytes were used in vain.
"""

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Any

import numpy as np

from .._core.kept import can_keep
from ..lines.lines import Lines
from ._jax import set_up_jax
from .model_choice import WantedCentre, WantedModel, one_centre

if TYPE_CHECKING:
    from .fitting import Fitted


@dataclasses.dataclass(frozen=True)
class Part:
    """What is rehearsed: the arguments of `calibrate` that programs depend on."""

    lines: Lines
    model: WantedModel
    centre: WantedCentre | None
    focal_sigma: np.ndarray
    shared: np.ndarray | None
    robust: bool = True

    def arguments(self) -> dict[str, Any]:
        """By name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}


@contextlib.contextmanager
def rehearsing(wanted: bool) -> Iterator[Callable[[Part], None]]:
    """Yield a function that begins a rehearsal, once, if it is wanted; the process ends with the block."""
    begun: list[BaseProcess] = []

    def begin(part: Part) -> None:
        if not wanted or begun or not can_keep():
            return
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=rehearse, args=(theirs,), daemon=True)
        try:
            with _interrupts_held():
                process.start()
        except Exception:  # a calibration does without
            ours.close()
            return
        finally:
            theirs.close()
        begun.append(process)
        # It first reads its modules; a pipe does not hold all lines.
        threading.Thread(target=_send, args=(ours, part), daemon=True).start()

    try:
        yield begin
    finally:
        for process in begun:
            process.kill()
            process.join()
            process.close()


def _send(connection: Connection, part: Part) -> None:
    with contextlib.suppress(Exception), connection:  # that process has ended, say
        connection.send(part)


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C is for this process: one that is begun meanwhile never sees it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, held)


def rehearse(connection: Connection) -> None:
    """Do the later steps of a calibration, in a process of its own, which ends when the other one does."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with open(os.devnull, "w") as nothing:
        for stream in (1, 2):
            os.dup2(nothing.fileno(), stream)
    set_up_jax()  # before there are arrays, which would be of single precision
    with contextlib.suppress(Exception):  # whatever is wrong with the lines is told by the other process
        steps(connection.recv())
    os._exit(0)  # a normal exit waits for compiler threads


def _end_with_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)


def steps(part: Part) -> Any:
    """The later steps, the last ones first: fits of frames, and what judges a fit of the model."""
    from .calibrating import judged

    how: Any = {"robust": part.robust, "focal_sigma": part.focal_sigma, "shared": part.shared}
    return judged(part.lines, _first_fits(part), **how)


def _first_fits(part: Part) -> "Fitted":
    """The fits about the centre given, with all lines, of the model that is tried first."""
    from ..fit.frames import fit_frames
    from ..fit.image_metric import in_image
    from ..fit.zoom import fit_zoom
    from .centre_found import CentreFound
    from .fitting import Fitted, compressed_about

    wanted = dataclasses.replace(part.model, distortion_model="radial")
    model, most = wanted.base(part.lines.focal), wanted.most_terms(part.lines)
    about = None if part.centre is None else one_centre(part.centre)
    held = in_image(compressed_about(part.lines, about, most))
    small, every = held.about(held.centre), np.ones(held.frame.shape)
    if part.robust:
        small, held = small.weighted(every), held.weighted(every)
    each = fit_frames(small, terms=model.terms, throw=False)
    fit = fit_zoom(small, zoom=model, throw=False)
    return Fitted(fit, each, small, held, model, CentreFound.of(held, None, None), None, (fit, small))
