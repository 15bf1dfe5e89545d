"""Lines over devices and processes, and data sets in many files, one file in memory at a time."""

import functools
import multiprocessing
import os
import re
import socket
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.lines import shard, stream

ROOT = Path(__file__).parents[2]


def in_two_processes(command, *, devices, folder):
    """Run a command twice, with 0 and 1 and the address of the first; what they print."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    flags = f"--xla_force_host_platform_device_count={devices} --xla_backend_optimization_level=0"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    ran = [
        subprocess.Popen(
            [sys.executable, *command, str(rank), "2", address],
            env=environment,
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in range(2)
    ]
    try:
        told = [process.communicate(timeout=300)[0] for process in ran]
    finally:
        for process in ran:
            process.kill()
    assert [process.returncode for process in ran] == [0, 0], "\n".join(told)
    return told


@pytest.mark.slow
def test_two_processes_fit_the_lens_of_one():
    """To 1e-12, each with some of the lines; they exchange sums by gloo."""
    told = in_two_processes(["-m", "tests._two_processes"], devices=2, folder=ROOT)
    assert all("as in one process 4" in each for each in told)


@pytest.mark.slow
def test_the_program_of_the_page_runs_in_two_processes(tmp_path, noisy):
    [program] = re.findall(r"```python processes\n(.*?)```", (ROOT / "docs/clusters.md").read_text(), re.S)
    (tmp_path / "fit.py").write_text(program)
    for rank in range(2):
        own = noisy.to_ragged()[rank::2]
        zj.Lines.from_ragged(
            own, np.asarray(noisy.frame)[rank::2], noisy.focal, image_size=noisy.image_size
        ).save(tmp_path / f"part-{rank}.npz")
    in_two_processes(["fit.py"], devices=1, folder=tmp_path)
    found, expected = zj.load_lens(tmp_path / "lens.json"), zj.fit_zoom(zj.compress(noisy)).lens
    np.testing.assert_allclose(found.zoom.parameters, expected.zoom.parameters, rtol=1e-12, atol=1e-12)


def test_one_device_takes_all(lines):
    spread = shard(lines, jax.devices()[:1])
    k = 0.01 * np.ones((len(lines.focal), 2))
    assert spread.number is None
    np.testing.assert_array_equal(spread.points, lines.points)
    np.testing.assert_allclose(zj.fit.global_energy(spread, k), zj.fit.global_energy(lines, k), rtol=1e-12)


@pytest.fixture(scope="module")
def lines():
    rng = np.random.default_rng(0)
    x = np.linspace(9, 600, 90)
    points = [np.stack([x, y + rng.standard_normal(90)], axis=-1) for y in np.linspace(5, 470, 8)]
    return zj.Lines.from_ragged(points, np.repeat([0, 1], 4), [24.0, 70.0], image_size=(640, 480))


def of_frame(lines, frame):
    points = [p for p, f in zip(lines.to_ragged(), lines.frame, strict=True) if f == frame]
    focal = lines.focal[frame : frame + 1]
    return zj.Lines.from_ragged(points, [0] * len(points), focal, image_size=(640, 480))


def same(found, expected):
    """The same sums of squares, whatever the order of points."""
    grams = [np.einsum("lij,lik->ljk", each.triangle, each.triangle) for each in (found, expected)]
    np.testing.assert_allclose(*grams, rtol=0, atol=1e-12 * np.abs(grams[1]).max())


def test_files_of_frames_are_one_data_set(lines, tmp_path):
    for frame in (0, 1):
        of_frame(lines, frame).save(tmp_path / f"{frame}.npz")
    files = sorted(tmp_path.iterdir())
    whole = zj.compress(lines)
    with ThreadPoolExecutor(2) as pool:
        for executor in (None, pool):
            found = zj.fit.concatenate(list(stream(files, executor=executor)))
            np.testing.assert_array_equal(found.frame, whole.frame)
            same(found, whole)


def test_files_of_points_merge_also_where_a_line_has_few(lines, tmp_path):
    """The first file has one point of the first line, and none of the second."""
    points = lines.to_ragged()
    cuts = [1, 0, *[40] * 6]
    for name, halves in (("a", [p[:c] for p, c in zip(points, cuts, strict=True)]), ("b", None)):
        part = [p[c:] for p, c in zip(points, cuts, strict=True)] if halves is None else halves
        zj.Lines.from_ragged(part, lines.frame, lines.focal, image_size=lines.image_size, chunk=True).save(
            tmp_path / f"{name}.npz"
        )
    read = functools.partial(zj.load_lines, chunk=True)
    found = functools.reduce(zj.lines.merge, stream(sorted(tmp_path.iterdir()), read=read))
    whole = zj.compress(lines)
    np.testing.assert_array_equal(found.counts, whole.counts)
    same(found, whole)


def test_a_bad_file_is_named(lines, tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    with ThreadPoolExecutor(1) as pool:
        for executor in (None, pool):
            with pytest.raises(ValueError, match=r"Cannot read lines from .*bad\.npz"):
                list(stream(tmp_path.iterdir(), executor=executor))


@pytest.mark.slow
def test_processes_give_the_same_triangles_in_float64(lines, tmp_path):
    for frame in (0, 1):
        of_frame(lines, frame).save(tmp_path / f"{frame}.npz")
    files = sorted(tmp_path.iterdir())
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        for there, here in zip(stream(files, executor=pool), stream(files), strict=True):
            assert there.triangle.dtype == np.float64
            same(there, here)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", [str, Path, os.fsencode])
def test_one_path_is_not_a_list_of_its_letters(kind, tmp_path):
    with pytest.raises(TypeError, match=r"paths must be a list of files, \[first, second\]"):
        list(zj.lines.stream(kind(str(tmp_path / "lines.npz"))))
