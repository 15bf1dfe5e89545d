"""What all tests share: float64, strict ranks, one seed, and small scenes with exact truth."""

import gc
import math
import os
import platform
import tempfile
import time
from pathlib import Path

import equinox as eqx
import hypothesis
import jax
import jaxtyping
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax._core import kept
from zoomjax._core.programs import use_once

SEED = 2012

# What the command line compiles, and finds in images, is kept between the tests of all workers, and not
# beyond them. Workers inherit the folder.
if "PYTEST_XDIST_WORKER" not in os.environ:
    _CACHE = tempfile.TemporaryDirectory(prefix="zoomjax-tests-")
    os.environ["ZOOMJAX_CACHE"] = _CACHE.name

# Tests compile far more than they compute: so without costly optimisation, and without the emitters of
# fusions, whose own compiler (MLIR) takes two thirds of the time that remains. The older emitters compute a
# value again where it is used again, and then multiply and add in one rounding here, in two there; without
# such instructions both are the same. XLA ends a process with a flag that it does not know: it has no other
# emitters from JAX 0.11 on. Each part in which a program is compiled costs: so in one.
FLAGS = [
    "--xla_backend_optimization_level=0",
    "--xla_llvm_disable_expensive_passes=true",
    "--xla_cpu_parallel_codegen_split_count=1",
    *(["--xla_cpu_use_fusion_emitters=false"] if jax.__version_info__ < (0, 11) else []),
    *(["--xla_cpu_max_isa=AVX"] if platform.machine() in ("x86_64", "AMD64") else []),
]
os.environ.setdefault("XLA_FLAGS", " ".join(FLAGS))

LAST_BITS = 0 if jax.default_backend() == "cpu" else 1e-13
"""Of numbers that are to be the same. A GPU adds up lines in any order, another one in each run."""

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

# Programs are kept from file to file, for each worker by itself: JAX locks the folder only if its size is
# limited, and then reads all of it for each program.
_KEPT = Path(os.environ["ZOOMJAX_CACHE"]) / "tests" / os.environ.get("PYTEST_XDIST_WORKER", "alone")
jax.config.update("jax_compilation_cache_dir", str(_KEPT))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
# Tests change what programs are made of: traced ones are kept by processes of their own alone.
keep_programs, kept.keep_programs = kept.keep_programs, lambda folder: None
# Python looks for garbage in cycles after 700 new objects, and JAX then looks too; tracing makes millions.
gc.set_threshold(50_000, 20, 50)
hypothesis.settings.register_profile("fixed", derandomize=True, deadline=None, max_examples=50)
hypothesis.settings.load_profile("fixed")


def pytest_itemcollected(item):
    if item.get_closest_marker("exhaustive"):
        item.add_marker(pytest.mark.slow)  # also of those that are left out by -m "not slow"


def pytest_collection_modifyitems(items):
    """Slow tests last, so that quick ones are not kept waiting and `SECONDS` leaves out slow ones alone.

    Where it does, the first is another each time, or the last ones would never run.
    """
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)
    slow = [item for item in items if item.get_closest_marker("slow")]
    if slow and math.isfinite(SECONDS):
        run = os.environ.get("PYTEST_XDIST_TESTRUNUID", "0")  # one number for all workers
        first = int(run, 16) % len(slow)
        items[-len(slow) :] = slow[first:] + slow[:first]
    gc.collect()
    gc.freeze()  # what was imported stays


def pytest_unconfigure():
    gc.unfreeze()


SECONDS = float(os.environ.get("ZOOMJAX_TEST_SECONDS", "inf"))
"""After so long, no slow test begins; those left are skipped, and the summary counts them."""

_BEGAN = time.monotonic()


def pytest_runtest_setup(item):
    if time.monotonic() - _BEGAN > SECONDS and item.get_closest_marker("slow"):
        pytest.skip(f"More than {SECONDS:g} s have passed (ZOOMJAX_TEST_SECONDS): slow tests are left out.")


def pytest_report_header(config):
    return f"zoomjax: seed {SEED}, float64 {jax.config.jax_enable_x64}, {jax.default_backend()}"


MOST_MAPS = 15_000
"""Memory maps of a process. A compiled program holds several; Linux allows 65530, and XLA crashes then."""


def _drop_programs():
    eqx.clear_caches()
    jax.clear_caches()


@pytest.fixture(scope="module", autouse=True)
def _programs_of_a_file_are_dropped():
    """Let go of what one file's tests compiled."""
    yield
    _drop_programs()


@pytest.fixture(autouse=True)
def _commands_leave_no_settings():
    """Sizes and settings of the compiler are those of the library again, after a command's."""
    yield
    use_once(False)


@pytest.fixture(autouse=True)
def _programs_of_a_test_are_dropped():
    """Let go of it earlier, where a file compiles very many."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        _drop_programs()


@pytest.fixture
def rng():
    return np.random.default_rng(SEED)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real data, which is not part of the package."""
    folder = os.environ.get("ZOOMJAX_DATA")
    if not folder:
        pytest.skip("Needs real data: set ZOOMJAX_DATA to the folder that holds it.")
    return Path(folder)


@pytest.fixture(scope="session")
def truth():
    """The lens of the paper's first experiment."""
    return scenes.nikkor_18_200()


NOISE = 0.5


@pytest.fixture(scope="session")
def clean(truth):
    """The paper's scene at four focal lengths, thinly sampled, without noise."""
    return scenes.board_lines(truth, scenes.focal_sweep(4), spacing=60.0)


@pytest.fixture(scope="session")
def noisy(truth):
    """The same points with edge noise; all shapes are those of `clean`."""
    return scenes.board_lines(truth, scenes.focal_sweep(4), spacing=60.0, noise=NOISE, seed=SEED)


@pytest.fixture(scope="session")
def small(noisy):
    return zj.compress(noisy)


@pytest.fixture(scope="session")
def fit(small):
    return zj.fit_zoom(small)


@pytest.fixture(scope="session")
def full_fit(noisy):
    return zj.fit_zoom(noisy)


@pytest.fixture(scope="session")
def frame_fits(small):
    return zj.fit_frames(small)


RAGGED_FRAMES = np.array([2, 0, 1, 2, 0, 2, 1, 2, 0])
RAGGED_COUNTS = (3, 40, 17, 5, 101, 16, 4, 33, 8)
RAGGED_SIZE = (640, 480)


@pytest.fixture(scope="session")
def ragged():
    """Nine bent lines of very different lengths in three frames of two, three and four lines."""
    rng = np.random.default_rng(SEED)
    points = []
    for count in RAGGED_COUNTS:
        start, end = rng.uniform((0, 0), RAGGED_SIZE, (2, 2))
        t = np.sort(rng.uniform(size=count))[:, None]
        bend = 20 * t * (1 - t) * rng.standard_normal(2)
        points.append(start + t * (end - start) + bend + 0.1 * rng.standard_normal((count, 2)))
    return zj.Lines.from_ragged(
        points, RAGGED_FRAMES, np.array([24.0, 50.0, 120.0]), image_size=RAGGED_SIZE
    )


@pytest.fixture(scope="session")
def _compile_events():
    events = []

    def listen(event, duration, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            events.append(duration)

    jax.monitoring.register_event_duration_secs_listener(listen)
    return events


@pytest.fixture
def compilations(_compile_events):
    """A function that tells how many programs were compiled since the test began or it was last called."""
    _compile_events.clear()

    def count() -> int:
        number = len(_compile_events)
        _compile_events.clear()
        return number

    return count


@pytest.fixture
def unchecked():
    """Without the types checked in tests, as users run the package: they see its own messages."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def moved(lines, points):
    """The same lines with other points."""
    return eqx.tree_at(lambda data: data.points, lines, points)
