"""The library with no extra: every public name is there, the main job is done, and nothing warns.

Run by `.ci/run` in a fresh environment, with warnings as errors.
"""

import importlib.util
import tempfile
from pathlib import Path

import cv2
import numpy as np

import zoomjax as zj
from zoomjax.app import calibrate

EXTRAS = ("matplotlib", "typer", "rich", "jinja2", "av", "filelock", "lensfunpy", "psutil", "torch")
found = [name for name in EXTRAS if importlib.util.find_spec(name)]
assert not found, f"this environment is not that of the bare library: it has {found}"

ROOMS = (zj.models, zj.focal, zj.io, zj.interop, zj.detect)
ROOMS += (zj.lines, zj.tracks, zj.correct, zj.scenes, zj.fit, zj.trust)
names = [getattr(door, name) for door in (zj, *ROOMS) for name in door.__all__]
assert len(names) > 100
assert callable(calibrate)  # a calibration draws nothing until it is written

truth = zj.scenes.nikkor_18_200()
scene = zj.scenes.board_lines(truth, zj.scenes.focal_sweep(5), spacing=60.0)
with tempfile.TemporaryDirectory() as folder:
    scene.save(lines := Path(folder) / "lines.npz")
    fit = zj.fit_zoom(zj.compress(zj.load_lines(lines)))
    fit.lens.save(file := Path(folder) / "lens.json")
    lens = zj.load_lens(file)
    assert float(fit.rms) < 0.5, f"lines without noise are off by {float(fit.rms)} px"
    assert bool(fit.certificate.certified)
    corner = np.zeros(2)
    off = np.abs(np.asarray(lens(35.0).undistort(corner) - truth(35.0).undistort(corner))).max()
    assert off < 1, f"the lens is off by {off} px"  # in float32
    size = (536, 356)
    photo = np.random.default_rng(0).integers(0, 256, (*size[::-1], 3)).astype(np.uint8)
    small = zj.scenes.nikkor_18_200(size)
    for suffix in (".jpg", ".tif"):
        cv2.imwrite(str(source := Path(folder) / f"photo{suffix}"), photo)
        zj.undistort_photo(source, Path(folder) / f"corrected{suffix}", lens=small, focal=35.0)
        assert (Path(folder) / f"corrected{suffix}").stat().st_size > 1000
print(f"{len(names)} public names; lines without noise are fitted to {float(fit.rms):.1e} px")
