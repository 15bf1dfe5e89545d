"""A process that compiles what comes last ends with the block, and leaves what a calibration needs."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from zoomjax import scenes
from zoomjax.app import rehearsal
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.rehearsal import Part, rehearsing

PART = """
import sys
import numpy as np
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.rehearsal import Part, rehearsing, steps
from zoomjax import load_lines
from zoomjax.app._jax import set_up_jax


def part():
    return Part(load_lines(sys.argv[1]), WantedModel(), "fit", np.zeros(6), None)
"""


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("ZOOMJAX_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def lines():
    return scenes.board_lines(scenes.nikkor_18_200(), scenes.focal_sweep(6), spacing=60, noise=0.3)


def run(script: str, *arguments: object, cache: object, check: bool = True) -> str:
    """What a script prints, in a process of its own."""
    own = {**os.environ, "ZOOMJAX_CACHE": str(cache)}
    command = [sys.executable, "-c", PART + script, *map(str, arguments)]
    return subprocess.run(command, env=own, capture_output=True, text=True, check=check).stdout


def test_a_rehearsal_is_begun_once_and_ends_with_the_block(lines):
    part = Part(lines, WantedModel(), "fit", np.zeros(6), None)
    with rehearsing(True) as begin:
        begin(part)
        begin(part)
        (process,) = multiprocessing.active_children()
        assert process.is_alive()
    assert not multiprocessing.active_children()


def test_none_is_begun_where_it_is_not_wanted(lines):
    with rehearsing(False) as begin:
        begin(Part(lines, WantedModel(), "fit", np.zeros(6), None))
        assert not multiprocessing.active_children()


def test_none_is_begun_where_programs_cannot_be_kept(lines, monkeypatch):
    monkeypatch.setattr(rehearsal, "can_keep", lambda: False)
    with rehearsing(True) as begin:
        begin(Part(lines, WantedModel(), "fit", np.zeros(6), None))
        assert not multiprocessing.active_children()


def test_a_calibration_goes_on_where_no_process_can_begin(lines, monkeypatch):
    def start(_):
        raise RuntimeError("no process")

    monkeypatch.setattr(multiprocessing.get_context("spawn").Process, "start", start)
    with rehearsing(True) as begin:
        begin(Part(lines, WantedModel(), "fit", np.zeros(6), None))
        assert not multiprocessing.active_children()


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="There is no SIGKILL.")
def test_it_ends_where_the_other_process_is_killed(lines, tmp_path):
    lines.save(tmp_path / "lines.npz")
    script = """
import multiprocessing, os, signal
with rehearsing(True) as begin:
    begin(part())
    print(multiprocessing.active_children()[0].pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""
    pid = int(run(script, tmp_path / "lines.npz", cache=tmp_path / "cache", check=False))
    until = time.monotonic() + 60
    while time.monotonic() < until and _runs(pid):
        time.sleep(0.1)
    assert not _runs(pid)


def _runs(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
def test_what_a_calibration_compiles_is_mostly_compiled(lines, tmp_path):
    """In folders of their own: neither finds what the other one kept."""
    file = tmp_path / "lines.npz"
    lines.save(file)
    run("set_up_jax()\nsteps(part())", file, cache=tmp_path / "rehearsed")
    script = """
set_up_jax()
from zoomjax.app.calibrating import calibrate
calibrate(**part().arguments())
"""
    run(script, file, cache=tmp_path / "calibrated")
    rehearsed, needed = (
        {path.stem for path in (tmp_path / name / "compiled").glob("*.traced")}
        for name in ("rehearsed", "calibrated")
    )
    assert len(needed) > 20
    assert len(rehearsed & needed) > 0.5 * len(needed)
    assert len(rehearsed - needed) < 0.2 * len(rehearsed)
