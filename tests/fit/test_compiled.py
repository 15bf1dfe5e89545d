"""The cache on disk of traced and compiled programs, from process to process."""

import os
import subprocess
import sys

import pytest

import zoomjax as zj

SCRIPT = """
import sys
if sys.argv[1] == "bare":
    sys.modules["filelock"] = None
import jax, numpy as np, zoomjax as zj
missed, traced = [], []
jax.monitoring.register_event_listener(lambda name, **_: missed.append(name))
jax.monitoring.register_event_duration_secs_listener(
    lambda name, seconds, fun_name="", **_: traced.append(fun_name) if "trace" in name else None
)
assert zj.cache_compiled() is not None
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
number = int(sys.argv[2])
t = np.linspace(0, 479, number)
places = [(f, x) for f in (1, 2, 3) for x in range(9, 600, number)]
bent = [np.stack([x + f * (t / 240 - 1) ** 2, t], axis=-1) for f, x in places]
frame = np.repeat([0, 1, 2], len(bent) // 3)
lines = zj.compress(zj.Lines.from_ragged(bent, frame, [50, 70, 100], image_size=(640, 480)))
zj.fit_zoom(lines, terms=1)
zj.fit_robust(lines, terms=1)
print(sum("cache_misses" in name for name in missed), sum("cache_hits" in name for name in missed))
print(len({"minimise", "fit_without_covariance", "_reweighted"} & set(traced)))
"""


def run(folder, *argv):
    own = {**os.environ, "ZOOMJAX_CACHE": str(folder)}
    own.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", SCRIPT, *argv],
        env=own,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return map(int, done.stdout.split())


@pytest.mark.slow
@pytest.mark.parametrize("how", ["with filelock", "bare"])
def test_a_later_process_with_other_sizes_traces_and_compiles_nothing(tmp_path, how):
    missed, _, traced = run(tmp_path, how, "40")
    assert missed > 3
    assert traced == 3
    missed, found, traced = run(tmp_path, how, "55")
    assert missed == 0
    assert found > 3
    assert traced == 0


TWO_FOLDERS = """
import os, sys
import jax, numpy as np, zoomjax as zj
os.chdir(sys.argv[1])
for number, folder in enumerate(("first", sys.argv[1] + "/second"), 2):
    zj.cache_compiled(folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    os.chdir("/")
    jax.block_until_ready(jax.jit(lambda x, n=number: x @ x + n)(np.eye(number)))
    print(len(os.listdir(sys.argv[1] + "/first")))
"""


@pytest.mark.slow
def test_the_last_folder_counts_wherever_one_is_meanwhile(tmp_path):
    """JAX opens a folder once, by the name that it is told."""
    own = {**os.environ}
    own.pop("JAX_COMPILATION_CACHE_DIR", None)
    command = [sys.executable, "-W", "error", "-c", TWO_FOLDERS, str(tmp_path)]
    done = subprocess.run(command, env=own, capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stderr) == (0, "")
    first, then = map(int, done.stdout.split())
    assert first == then > 0
    assert os.listdir(tmp_path / "second")


@pytest.fixture
def settings(monkeypatch):
    """What `cache_compiled` tells JAX, which does not hear it."""
    import jax

    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    told = {}
    monkeypatch.setattr(jax.config, "update", told.__setitem__)
    return told


def test_the_folder_is_the_one_given_or_the_users(tmp_path, monkeypatch, settings):
    monkeypatch.setenv("ZOOMJAX_CACHE", str(tmp_path / "cache"))
    assert zj.cache_compiled() == tmp_path / "cache" / "compiled"
    assert zj.cache_compiled(tmp_path / "own") == tmp_path / "own"
    assert settings["jax_compilation_cache_dir"] == str(tmp_path / "own")
    assert settings["jax_compilation_cache_max_size"] == 100_000_000


def test_a_folder_that_jax_was_told_of_stays(tmp_path, monkeypatch, settings):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    assert zj.cache_compiled(tmp_path / "own") == tmp_path
    assert settings == {}


def test_nothing_is_kept_where_nothing_can_be_written(tmp_path, settings):
    (tmp_path / "file").write_text("")
    assert zj.cache_compiled(tmp_path / "file" / "folder") is None
    assert settings == {}


def test_torn_programs_are_removed(tmp_path, settings):
    for name in ("whole-cache", "whole-atime", "torn-cache"):
        (tmp_path / name).write_text("")
    (tmp_path / "folder-cache").mkdir()
    zj.cache_compiled(tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["whole-atime", "whole-cache"]


def test_programs_stay_where_jax_does_not_count_them(tmp_path, settings):
    (tmp_path / "one-cache").write_text("")
    zj.cache_compiled(tmp_path)
    assert os.listdir(tmp_path) == ["one-cache"]
