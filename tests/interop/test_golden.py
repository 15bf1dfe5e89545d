"""Files for tools that cannot be run here, kept as they were when they were looked at line by line.

A change of a writer shows here. The readers of `_readers`, which are written from the tools' documentation
and apart from the writers, read the very files. ``python -m tests.interop.test_golden`` writes them anew.
"""

import re
import tempfile
from pathlib import Path

import numpy as np
import pytest

import zoomjax as zj

from ._lenses import LENSES, PITCH
from .test_write import MARGIN, error

FOLDER = Path(__file__).parent / "golden"
FOCAL = [18.0, 19.0, 60.0, 190.0, 200.0]
TRACK = zj.io.FocalTrack(np.array([1001.0, 1003.0]), np.array([18.0, 60.0]), by_time=False)
FILES = {
    "degree-4.nk": ("nuke", "decentred", {"track": TRACK}),
    "rational.nk": ("nuke", "wide, three terms", {"track": TRACK}),
    "lens.pfb": ("pftrack", "landscape", {"track": TRACK}),
    "lens.jsonl": ("opentrackio", "decentred", {"track": TRACK}),
    "gyroflow.json": ("gyroflow", "landscape", {"focal": FOCAL}),
    "lens.ulens": ("unreal", "decentred", {"focal": FOCAL}),
    "lens.pto": ("hugin", "portrait", {"track": TRACK}),
}
"""The format, the lens and what is written of each."""

NUMBER = re.compile(r"-?\d+(?:\.\d+(?:e[-+]?\d+)?|e[-+]?\d+)")
"""With a decimal point or an exponent; others are the same to the digit."""


def written(name, path):
    format, lens, what = FILES[name]
    return zj.interop.write(LENSES[lens](), path, format=format, pixel_pitch=PITCH, **what)


@pytest.mark.parametrize("name", FILES)
def test_a_file_is_written_as_it_was(name, tmp_path):
    written(name, tmp_path / name)
    now, then = ((folder / name).read_text() for folder in (tmp_path, FOLDER))
    assert NUMBER.sub("#", now) == NUMBER.sub("#", then)
    numbers = [np.array(NUMBER.findall(text), float) for text in (now, then)]
    assert numbers[0] == pytest.approx(numbers[1], rel=1e-3, abs=1e-6)  # refits differ by libraries


@pytest.mark.parametrize("name", FILES)
def test_a_file_means_the_lens_by_the_tools_documentation(name, tmp_path):
    format, lens, what = FILES[name]
    report = written(name, tmp_path / name)
    focal = FOCAL if "focal" in what else [TRACK.at(frame, np.nan) for frame in (1001, 1002, 1003)]
    for index, f in enumerate(focal):
        assert error(format, FOLDER / name, LENSES[lens](), float(f), index) <= report.at_nodes + MARGIN


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in FILES:
            written(name, Path(folder) / name)
            (FOLDER / name).write_text((Path(folder) / name).read_text())
