"""What other tools make of files: by their own code where Python has it, else by their documentation.

Written apart from the package: none of its code is used. Each reader takes a file, a focal length and
points, and maps points from one image to the other; `CORRECTS` names those that map distorted to corrected
points.
"""

import ast
import json
import re

import cv2
import lensfunpy
import numpy as np
import pycolmap
import yaml
from discorpy.losa.loadersaver import load_metadata_txt
from discorpy.post.postprocessing import unwarp_line_forward

CORRECTS = ("nuke", "opentrackio", "pftrack")


def project(matrix, k, points):
    """OpenCV's positions of corrected points."""
    matrix = np.array(matrix, float).reshape(3, 3)
    rays = (points - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    rays = np.column_stack([rays, np.ones(len(rays))])[:, None]
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(k, float))[0][:, 0]


def opencv(path, focal, points, **_):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix, k = (file.getNode(n).mat() for n in ("camera_matrix", "distortion_coefficients"))
    assert int(file.getNode("image_width").real()) > 0
    return project(matrix, k, points)


def ros(path, focal, points, **_):
    table = yaml.safe_load(path.read_text())
    assert table["distortion_model"] == "rational_polynomial"
    assert table["projection_matrix"]["data"][:3] == table["camera_matrix"]["data"][:3]
    return project(table["camera_matrix"]["data"], table["distortion_coefficients"]["data"], points)


def kalibr(path, focal, points, **_):
    camera = yaml.safe_load(path.read_text())["cam0"]
    fx, fy, cx, cy = camera["intrinsics"]
    return project([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], camera["distortion_coeffs"], points)


def mrcal(path, focal, points, **_):
    model = ast.literal_eval(path.read_text())
    assert model["lensmodel"] == "LENSMODEL_OPENCV8"
    fx, fy, cx, cy, *k = model["intrinsics"]
    return project([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], k, points)


def colmap(path, focal, points, *, index, **_):
    folder = path.parent / f"{path.stem}-model"
    folder.mkdir(exist_ok=True)
    (folder / "cameras.txt").write_text(path.read_text())
    for name in ("images", "points3D", "rigs", "frames"):
        (folder / f"{name}.txt").write_text("")
    model = pycolmap.Reconstruction()
    model.read_text(str(folder))
    camera = model.cameras[index + 1]
    matrix = camera.calibration_matrix()
    rays = (points + 0.5 - matrix[:2, 2]) / matrix[0, 0]
    rays = np.column_stack([rays, np.ones(len(rays))])
    return np.array([camera.img_from_cam(ray) for ray in rays]) - 0.5


def nerfstudio(path, focal, points, *, index, **_):
    frame = json.loads(path.read_text())["frames"][index]
    matrix = [[frame["fl_x"], 0, frame["cx"] - 0.5], [0, frame["fl_y"], frame["cy"] - 0.5], [0, 0, 1]]
    return project(matrix, [frame[name] for name in ("k1", "k2", "p1", "p2", "k3")], points)


def gyroflow(path, focal, points, *, mm, **_):
    table = json.loads(path.read_text())
    assert table["distortion_model"] == "opencv_standard"
    assert table["asymmetrical"] is True
    keys = sorted(table["interpolations"], key=float)
    at = np.array([float(key) for key in keys])
    rows = [table["interpolations"][key] for key in keys]
    i = int(np.clip(np.searchsorted(at, mm) - 1, 0, len(at) - 2))
    t = (mm - at[i]) / (at[i + 1] - at[i])
    matrix, k = (
        (1 - t) * np.array(rows[i][name]) + t * np.array(rows[i + 1][name])
        for name in ("camera_matrix", "distortion_coeffs")
    )
    return project(matrix, k, points)


def unreal(path, focal, points, *, size, **_):
    table = json.loads(path.read_text())
    assert table["metadata"]["type"] == "LensFile"
    read = {}
    for entry in table["cameraParameterTables"]:
        rows = np.array([[float(v) for v in row.split(",")] for row in entry["data"].split(";")])
        assert rows.shape[1] == len(entry["header"].split(","))
        read[entry["parameterName"]] = [np.interp(focal, rows[:, 1], column) for column in rows[:, 2:].T]
    k1, k2, k3, p1, p2 = read["DistortionTable"]
    (fx, fy), (cx, cy) = read["FocalLengthTable"], read["ImageCenterTable"]
    w, h = size
    return project(
        [[fx * w, 0, cx * w - 0.5], [0, fy * h, cy * h - 0.5], [0, 0, 1]], [k1, k2, p1, p2, k3], points
    )


def lensfun(path, focal, points, *, size, mm, **_):
    database = lensfunpy.Database(xml=path.read_text(), load_common=False, load_bundled=False)
    [lens] = database.lenses
    modifier = lensfunpy.Modifier(lens, lens.crop_factor, *size)
    modifier.initialize(mm, 4, 10, scale=1.0, flags=lensfunpy.ModifyFlags.DISTORTION)
    at = [
        np.asarray(modifier.apply_geometry_distortion(float(x), float(y), 1, 1)).reshape(2)
        for x, y in points
    ]
    return np.array(at)


def hugin(path, focal, points, *, index, size, px, **_):
    """A panorama of another focal length than the photo, which Hugin scales."""
    line = [line for line in path.read_text().splitlines() if line.startswith("i ")][index]
    words = dict(re.findall(r" ([a-z])([-\d.e]+)", line))
    v, a, b, c, d, e = (float(words[name]) for name in "vabcde")
    assert (int(words["w"]), int(words["h"])) == tuple(size)
    middle, half = (np.array(size) - 1) / 2, min(size) / 2
    ahead = size[0] / 2 / np.tan(np.radians(v) / 2) / px
    z = (points - middle - [d, e]) * ahead / half
    r = np.hypot(*z.T)[:, None]
    return middle + [d, e] + half * z * (a * r**3 + b * r**2 + c * r + 1 - a - b - c)


def opentrackio(path, focal, points, *, index, size, **_):
    sample = json.loads(path.read_text().splitlines()[index])
    sensor = sample["static"]["camera"]["activeSensorPhysicalDimensions"]
    pitch = np.array([sensor["width"], sensor["height"]]) / size
    lens = sample["lens"]
    offset = np.array([lens["distortionOffset"]["x"], lens["distortionOffset"]["y"]])
    [distortion] = lens["distortion"]
    assert distortion["model"] == "Brown-Conrady D-U"
    k1, k2, k3, k4, k5, k6 = distortion["radial"]
    p1, p2 = distortion["tangential"]
    x, y = ((points - (np.array(size) - 1) / 2) * pitch - offset).T
    r2 = x * x + y * y
    factor = (1 + k1 * r2 + k3 * r2**2 + k5 * r2**3) / (1 + k2 * r2 + k4 * r2**2 + k6 * r2**3)
    u = x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return (np.stack([u, v], -1) + offset) / pitch + (np.array(size) - 1) / 2


def knob(text, name, index):
    """The value of a Nuke knob, or that of a key."""
    [value] = components(text, name, index)
    return value


def components(text, name, index):
    """The values of a knob of one component or several, each a number or a curve with a key for each."""
    value = re.search(rf"^ {name} (.+)$", text, re.MULTILINE)[1]
    inner = value[1:-1] if value.startswith("{") else value
    found = []
    for curve, number in re.findall(r"\{curve ([^{}]+)\}|([^ {}]+)", inner):
        found.append(
            [float(v) for v in re.findall(r"x\d+ (\S+)", curve)][index] if curve else float(number)
        )
    return found


def nuke(path, focal, points, *, index, size, **_):
    text = path.read_text()
    if text.startswith("LensDistortion2"):
        return nuke_rational(text, points, index, size)
    w, h = (knob(text, f"tde4_filmback_{side}_cm", index) for side in ("width", "height"))
    off = [knob(text, f"tde4_lens_center_offset_{axis}_cm", index) for axis in "xy"]
    radius = np.hypot(w, h) / 2
    # Unit coordinates from the lower left corner of the filmback, pixel centres at half integers.
    x = ((points[:, 0] + 0.5) / size[0] - 0.5) * w - off[0]
    y = (0.5 - (points[:, 1] + 0.5) / size[1]) * h - off[1]
    x, y = x / radius, y / radius
    c2, c4, u1, v1 = (
        knob(text, name, index)
        for name in ("Distortion_Degree_2", "Quartic_Distortion_Degree_4", "U_Degree_2", "V_Degree_2")
    )
    r2 = x * x + y * y
    factor = 1 + c2 * r2 + c4 * r2**2
    u = x * factor + (r2 + 2 * x * x) * u1 + 2 * x * y * v1
    v = y * factor + (r2 + 2 * y * y) * v1 + 2 * x * y * u1
    u, v = u * radius + off[0], v * radius + off[1]
    return np.stack([(u / w + 0.5) * size[0] - 0.5, (0.5 - v / h) * size[1] - 0.5], -1)


def nuke_rational(text, points, index, size):
    centre = components(text, "centre", index)
    half = np.hypot(*size) / 2
    z = (points - (np.array(size) - 1) / 2) / half * [1, -1] - np.array(centre, float)
    r2 = np.sum(z * z, -1, keepdims=True)
    over, under = (
        1 + sum(knob(text, f"distortion{part}{i}", index) * r2 ** (i + 1) for i in range(3))
        for part in ("Numerator", "Denominator")
    )
    back = z * over / under + np.array(centre, float)
    return back * half * [1, -1] + (np.array(size) - 1) / 2


def pftrack(path, focal, points, *, index, size, **_):
    lines = path.read_text().splitlines()
    assert lines[0] == "#PFBarrel 2011 v2"
    assert [int(v) for v in lines[1:3]] == list(size)
    assert lines[6] == "High Order"
    _, c3, c5, xp, yp = (float(v) for v in lines[9 + 5 * index : 14 + 5 * index])
    w, h = size
    radius = np.hypot(w, h) / np.sqrt(2)
    centre = np.array([xp * w, h - 1 - yp * h])
    z = (points - centre) / radius
    r2 = np.sum(z * z, -1, keepdims=True)
    return centre + radius * z * (1 + c3 * r2 + c5 * r2**2)


def discorpy(path, focal, points, **_):
    """Its forward function evaluates the same polynomial as its backward one, at any points (y, x)."""
    x, y, factors = load_metadata_txt(str(path))
    [found] = unwarp_line_forward([points[:, ::-1].copy()], x, y, factors)
    return found[:, ::-1]


READERS = {
    reader.__name__: reader
    for reader in (
        *(opencv, ros, kalibr, mrcal, colmap, nerfstudio, discorpy),
        *(gyroflow, unreal, lensfun, hugin, opentrackio, nuke, pftrack),
    )
}
