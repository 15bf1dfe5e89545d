"""Processes that die, hang or eat memory cost their task; real ones, really ended."""

import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from zoomjax.detect._workers import LostError, Workers

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits a process's memory")


def task(item):
    """What an item asks for."""
    what, value = item
    if what == "square":
        return value**2
    if what == "die":
        os.kill(os.getpid(), value)
    if what == "die once":  # as for the want of memory of another
        if not Path(value).exists():
            Path(value).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return "second try"
    if what == "exit":
        os._exit(value)
    if what == "raise":
        raise SystemExit(value)
    if what == "hang":
        time.sleep(1000)
    if what == "take":
        try:
            np.empty(value, np.uint8)
        except MemoryError:
            return "no memory"
    if what == "large":
        return bytes(value)
    if what == "shout":
        os.write(2, b"shouted\n")
    if what == "interrupted":
        os.kill(os.getpid(), signal.SIGINT)
    return "done"


def results(items, number=2, seconds=60.0):
    with Workers(task, number, seconds) as workers:
        futures = [workers.submit(item) for item in items]
        return [future.exception() or future.result() for future in futures]


DEATHS = [("die", signal.SIGKILL), ("die", signal.SIGSEGV), ("exit", 3), ("raise", 4)]


def open_files():
    gc.collect()
    return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0


def test_a_process_that_dies_costs_its_task_only():
    results([("square", 1)])  # opens what stays open
    before = open_files()
    items = [("square", n) for n in range(12)]
    for place, death in zip((0, 3, 4, 9), DEATHS, strict=True):
        items.insert(place, death)
    found = results(items)
    lost = [str(answer) for answer in found if isinstance(answer, LostError)]
    assert [answer for answer in found if not isinstance(answer, LostError)] == [n**2 for n in range(12)]
    for text, name in zip(lost, ("SIGKILL", "SIGSEGV", "status 3", "status 4"), strict=True):
        assert name in text
    assert multiprocessing.active_children() == []
    assert open_files() == before


def test_what_was_lost_with_its_process_is_tried_again(tmp_path):
    assert results([("die once", str(tmp_path / "mark")), ("square", 3)], 1) == ["second try", 9]


def test_a_task_that_hangs_is_ended():
    start = time.monotonic()
    found = results([("square", 2), ("hang", 0), ("square", 3), ("square", 4)], seconds=1.5)
    assert "took more than 2 s" in str(found.pop(1))
    assert found == [4, 9, 16]
    assert time.monotonic() - start < 60


@LINUX
def test_memory_is_limited_before_the_machine_has_none():
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert results([("take", int(0.6 * physical)), ("square", 3)], 1) == ["no memory", 9]


def test_results_larger_than_a_pipe_come_back_whole():
    assert results([("large", 5_000_000)] * 3) == [bytes(5_000_000)] * 3


def test_nothing_is_printed_and_interrupts_are_for_others(capfd):
    assert results([("shout", 0), ("interrupted", 0), ("die", signal.SIGABRT)], 1)[:2] == ["done", "done"]
    assert capfd.readouterr() == ("", "")


def test_leaving_ends_what_is_being_done():
    start = time.monotonic()
    with Workers(task, 2, 500.0) as workers:
        futures = [workers.submit(("hang", 0)) for _ in range(6)]
        time.sleep(0.2)
    assert all(future.done() for future in futures)
    assert time.monotonic() - start < 60
    assert multiprocessing.active_children() == []


ORPHAN = """
import os, sys, time
sys.path.insert(0, {tests!r})
from tests.detect.test_workers import task
from zoomjax.detect._workers import Workers
if __name__ == "__main__":
    with Workers(task, 1, 100.0) as workers:
        workers.submit(("square", 2)).result()
        print(next(iter(workers._processes)).pid, flush=True)
        time.sleep(100)
"""


@pytest.mark.skipif(not os.path.isdir("/proc"), reason="needs a list of processes")
def test_processes_end_with_a_parent_that_is_killed(tmp_path):
    (tmp_path / "orphan.py").write_text(ORPHAN.format(tests=str(Path(__file__).parents[2])))
    parent = subprocess.Popen([sys.executable, tmp_path / "orphan.py"], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    for _ in range(200):
        if (
            not Path(f"/proc/{worker}").exists()
            or "Z" in Path(f"/proc/{worker}/stat").read_text().split()[2]
        ):
            return
        time.sleep(0.1)
    pytest.fail("It is still there after 20 s.")


UNGUARDED = """
import sys
sys.path.insert(0, {tests!r})
from tests.detect.test_workers import task
from zoomjax.detect._workers import Workers
with Workers(task, 1, 100.0) as workers:
    print(workers.submit(("square", 2)).result())
"""


def test_a_program_that_cannot_be_begun_again_is_told_so(tmp_path):
    """A script without ``if __name__ == "__main__"``: no file is to blame."""
    (tmp_path / "script.py").write_text(UNGUARDED.format(tests=str(Path(__file__).parents[2])))
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py"], capture_output=True, text=True, timeout=300, check=False
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert "RuntimeError: A detection process cannot be started" in done.stderr


@LINUX
def test_processes_are_forked_from_one_that_has_imported_what_they_need():
    """In a process of its own, as it is for good: results, deaths and messages are the same."""
    script = """
import sys
from zoomjax._core.forked import import_ahead
from tests.detect.test_workers import results
from zoomjax.detect._workers import LostError

if __name__ == "__main__":
    import_ahead("tests.detect.test_workers")
    import_ahead("tests.detect.test_workers")
    found = results([("square", 3), ("die", 9), ("shout", 0), ("interrupted", 0), ("square", 4)])
    assert isinstance(found[1], LostError), found
    assert "SIGKILL" in str(found[1])
    assert [found[0], *found[2:]] == [9, "done", "done", 16], found
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
