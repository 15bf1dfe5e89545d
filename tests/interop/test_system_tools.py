"""Files read and written by tools that no package index has, where they are there: mrcal and Hugin.

On Debian: ``apt install python3-mrcal hugin-tools``. What mrcal gave is in
benchmarks/results/interop_mrcal.md.
"""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest

import zoomjax as zj

from ._lenses import LENSES, PITCH
from ._pythons import python_with, run
from .test_write import MARGIN, shown

PROJECT = """
import json, sys, mrcal, numpy as np
path, points = json.load(sys.stdin)
model = mrcal.cameramodel(path)
fx, fy, cx, cy = model.intrinsics()[1][:4]
points = np.array(points, float)
rays = np.column_stack([(points[:, 0] - cx) / fx, (points[:, 1] - cy) / fy, np.ones(len(points))])
print(json.dumps(mrcal.project(rays, *model.intrinsics()).tolist()))
"""

WRITE = """
import json, sys, mrcal, numpy as np
path, lensmodel, intrinsics, size = json.load(sys.stdin)
model = mrcal.cameramodel(intrinsics=(lensmodel, np.array(intrinsics)), imagersize=np.array(size))
model.write(path)
"""


def python():
    return python_with("mrcal", "apt install python3-mrcal")


def mrcal(program, *given):
    return run(python(), program, *given)


@pytest.mark.parametrize("name", LENSES)
def test_mrcal_does_as_the_lens(name, tmp_path):
    lens = LENSES[name]()
    python()
    focal = np.geomspace(*np.asarray(lens.focal_range), 3)
    report = zj.interop.write(lens, tmp_path / "out", format="mrcal", focal=focal, pixel_pitch=PITCH)
    worst = 0.0
    for f, path in zip(focal, report.files, strict=True):
        distorted = shown(lens)
        corrected = np.asarray(lens(float(f)).undistort(distorted))
        found = np.array(json.loads(mrcal(PROJECT, str(path), corrected.tolist())))
        worst = max(worst, float(np.hypot(*(found - distorted).T).max()))
    print(f"{name}: reported {report.worst:.2g} px, found {worst:.2g} px")
    assert worst <= report.worst + MARGIN


@pytest.mark.parametrize(
    ("model", "k"),
    [
        ("LENSMODEL_PINHOLE", []),
        ("LENSMODEL_OPENCV4", [-0.2, 0.05, 1e-3, -5e-4]),
        ("LENSMODEL_OPENCV5", [-0.2, 0.05, 1e-3, -5e-4, 0.01]),
        ("LENSMODEL_OPENCV8", [0.1, 0.05, 0.0, 0.0, 0.01, 0.3, 0.02, 0.01]),
    ],
)
def test_what_mrcal_writes_is_read(model, k, tmp_path):
    path, size = tmp_path / "a.cameramodel", (640, 480)
    mrcal(WRITE, str(path), model, [800.0, 800.0, 325.0, 236.0, *k], size)
    read = zj.interop.read(path)
    assert read.lens.image_size == size
    distorted = np.stack(np.meshgrid(np.linspace(0, 639, 7), np.linspace(0, 479, 6)), -1).reshape(-1, 2)
    corrected = np.asarray(read.lens(800.0).undistort(distorted))
    found = np.array(json.loads(mrcal(PROJECT, str(path), corrected.tolist())))
    # The report is of corrected points; correction stretches by a third at most here.
    assert np.hypot(*(found - distorted).T).max() <= 1.4 * read.report.worst + MARGIN


@pytest.mark.parametrize("name", [name for name in LENSES if "decentred" not in name])
def test_hugin_does_as_the_lens(name, tmp_path):
    """Into a panorama of the photo's own field of view, whose middle is the photo's centre."""
    if shutil.which("pano_trafo") is None:
        pytest.skip("Needs pano_trafo (apt install hugin-tools).")
    lens, path = LENSES[name](), tmp_path / "a.pto"
    width = lens.image_size[0]
    for f in np.asarray(lens.focal_range).tolist():
        report = zj.interop.write(lens, path, focal=f, pixel_pitch=PITCH, overwrite=True)
        text = path.read_text()
        view = float(re.search(r" v(\S+)", text[text.index("\ni ") :])[1])
        path.write_text(text.replace(" v50", f" v{view}"))
        distorted = shown(lens)
        corrected = np.asarray(lens(f).undistort(distorted)) - np.asarray(lens.centre_at(f))
        f_px = f / PITCH if lens.focal_unit == "mm" else f
        ahead = width / 2 / np.tan(np.radians(view) / 2) / f_px
        given = (np.array(lens.image_size) - 1) / 2 + ahead * corrected
        done = subprocess.run(
            ["pano_trafo", "-r", str(path), "0"],
            input="".join(f"{x:.9f} {y:.9f}\n" for x, y in given),
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        found = np.array([line.split()[:2] for line in done.stdout.splitlines()], float)
        worst = np.hypot(*(found - distorted).T).max()
        print(f"{name}, {f:g}: reported {report.worst:.2g} px, found {worst:.2g} px")
        assert worst <= report.worst + MARGIN
