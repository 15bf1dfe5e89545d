"""Memory and open files do not grow with the number of images: scaled down from `reliability_memory`."""

import pytest

pytest.importorskip("av")
pytest.importorskip("psutil")

LEAST_SHOWN = 4.0
"""MB: of 120 small pictures, 9 MB would be held if each were kept."""


@pytest.mark.exhaustive
def test_photographs_frames_and_bad_files_leave_nothing_behind():
    from benchmarks import reliability_memory

    for name, row in reliability_memory.run(photos=160, frames=160, bad=160, workers=1).items():
        assert row["tried"] == 160, name
        assert (row["problems"] > 100) == (name == "bad files")
        assert row["MB"] < LEAST_SHOWN, name
        assert row["MB of workers"] < LEAST_SHOWN, name
        assert row["files"] <= 1, name
        assert row["processes"] == 0, name
