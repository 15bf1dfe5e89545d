"""Maps and coefficients used by Blender's compositor, where some Python has Blender as a module.

``python3.11 -m venv blender && blender/bin/pip install bpy``, and ZOOMJAX_BPY=blender/bin/python if that is
not on the path. What Blender gave is in benchmarks/results/interop_blender.md. The images hold their own
coordinates, so that a warped one shows where it was sampled.
"""

import json

import numpy as np
import OpenEXR
import pytest

import zoomjax as zj
from zoomjax.models import Division

from ._lenses import LENSES, PITCH, polynomial
from ._pythons import python_with, run
from .test_write import MARGIN

RENDER = """
import json, os, sys
import bpy

scene = bpy.context.scene
scene.view_settings.view_transform = "Raw"
scene.render.compositor_precision = "FULL"
scene.render.image_settings.file_format = "OPEN_EXR"
scene.render.image_settings.color_depth = "32"

def image(tree, path, frames=0):
    node = tree.nodes.new("CompositorNodeImage")
    node.image = bpy.data.images.load(path)
    node.image.colorspace_settings.name = "Non-Color"
    if frames:
        node.image.source = "SEQUENCE"
        node.frame_duration = frames
    return node.outputs["Image"]

def distortion(tree, job):
    node = tree.nodes.new("CompositorNodeMovieDistortion")
    node.clip = bpy.data.movieclips.load(job["image"])
    for name, value in job["camera"].items():
        setattr(node.clip.tracking.camera, name, value)
    node.inputs["Type"].default_value = job["type"]
    return node

def warped(tree, job):
    if "map" in job:
        node = tree.nodes.new("CompositorNodeMapUV")
        tree.links.new(image(tree, job["map"], job.get("frames", 0)), node.inputs["UV"])
    else:
        node = distortion(tree, job)
    tree.links.new(image(tree, job["image"]), node.inputs["Image"])
    return node.outputs["Image"]

os.dup2(2, 1)  # what Blender says is of no interest
[jobs] = json.load(sys.stdin)
for job in jobs:
    tree = bpy.data.node_groups.new("lens", "CompositorNodeTree")
    tree.interface.new_socket(name="Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    tree.links.new(warped(tree, job), tree.nodes.new("NodeGroupOutput").inputs["Image"])
    scene.compositing_node_group = tree
    scene.render.resolution_x, scene.render.resolution_y = job["size"]
    scene.render.filepath = job["out"]
    scene.frame_set(job.get("frame", 1))
    bpy.ops.render.render(write_still=True)
"""

KINDS = {"undistort": "distort", "redistort": "undistort"}
"""Maps and nodes of these names sample at what the lens's method gives."""


def python():
    return python_with("bpy", "pip install bpy, for Python 3.11", "ZOOMJAX_BPY")


def opened(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        pixels = [np.array(file.channels()[name].pixels, float) for name in "RGB"]
        return np.stack(pixels, -1), np.asarray(file.header()["dataWindow"])[0]


def of_coordinates(path, size):
    """An image of its own coordinates, and 1 in blue."""
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.stack([x, y, np.ones_like(x)], -1)}) as file:
        file.write(str(path))
    return str(path)


def grid(pixels, start=(0, 0)):
    """The position of every pixel, from (0, 0) of the photo's frame."""
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]].astype(float)
    return np.stack([x, y], -1) + start


def difference(pixels, wanted, size):
    """The greatest distance, px, where the image was sampled well within its border."""
    inside = ((wanted > 2) & (wanted < np.array(size) - 3)).all(-1)
    assert inside.mean() > 0.5
    return np.hypot(*np.moveaxis(pixels[..., :2] - wanted, -1, 0))[inside].max()


@pytest.mark.slow
@pytest.mark.parametrize("name", LENSES)
def test_blender_warps_by_maps(name, tmp_path):
    """By the node Map UV; its result has the size of the map's data window."""
    lens, ours = LENSES[name](), python()
    focal = np.asarray(lens.focal_range)
    report = zj.interop.write(lens, tmp_path / "maps", format="stmap", focal=focal)
    ramp = of_coordinates(tmp_path / "ramp.exr", lens.image_size)
    jobs = []
    for path in report.files:
        height, width = opened(path)[0].shape[:2]
        jobs.append(
            {"map": str(path), "image": ramp, "out": f"{tmp_path}/{path.name}", "size": [width, height]}
        )
    run(ours, RENDER, jobs)
    worst = 0.0
    for path, f in zip(report.files, np.repeat(focal, 2), strict=True):
        found, start = opened(tmp_path / path.name)[0], opened(path)[1]
        exact = getattr(lens(float(f)), KINDS[path.name.split(".")[0]])
        worst = max(worst, difference(found, np.asarray(exact(grid(found, start))), lens.image_size))
    print(f"| {name} | maps | {report.worst:.2g} | {worst:.2g} |")
    assert worst <= report.worst + MARGIN


def test_blender_follows_a_zoom_by_a_sequence_of_maps(tmp_path):
    """Its own coefficients have no keyframes."""
    lens, ours = LENSES["landscape"](), python()
    track = zj.io.FocalTrack(np.array([1.0, 3.0]), np.array([18.0, 40.0]), by_time=False)
    zj.interop.write(lens, tmp_path / "maps", format="stmap", track=track)
    ramp = of_coordinates(tmp_path / "ramp.exr", lens.image_size)
    job = {"map": f"{tmp_path}/maps/redistort.000001.exr", "frames": 3, "image": ramp}
    job |= {"size": lens.image_size}
    run(ours, RENDER, [job | {"frame": n, "out": f"{tmp_path}/{n}.exr"} for n in (1, 2, 3)])
    for frame in (1, 2, 3):
        found = opened(tmp_path / f"{frame}.exr")[0]
        wanted = np.asarray(lens(float(track.at(frame, np.nan))).undistort(grid(found)))
        assert difference(found, wanted, lens.image_size) < MARGIN


def camera(lens, path, focal):
    """What a clip's camera gets of the frames of nerfstudio, and the writer's report.

    y points up there. Of two tangential coefficients, the first goes with y there and with x in Blender.
    """
    report = zj.interop.write(lens, path, format="nerfstudio", focal=focal, pixel_pitch=PITCH)
    [frame] = json.loads(path.read_text())["frames"]
    told = {"units": "PIXELS", "sensor_width": 36.0, "focal_length_pixels": frame["fl_x"]}
    told["principal_point_pixels"] = [frame["cx"], frame["h"] - frame["cy"]]
    if frame["p1"] or frame["p2"]:
        told |= {"distortion_model": "BROWN", "brown_p1": frame["p2"], "brown_p2": -frame["p1"]}
        return told | {f"brown_k{i}": frame[f"k{i}"] for i in (1, 2, 3)}, report.worst
    return told | {"distortion_model": "POLYNOMIAL"} | {
        f"k{i}": frame[f"k{i}"] for i in (1, 2, 3)
    }, report.worst


def nuke_camera(lens, focal):
    """A division model of two terms is Blender's model "Nuke", for radii in half the longer side."""
    width, height = lens.image_size
    x, y = np.asarray(lens.centre_at(focal)) + 0.5
    unit = max(width, height) / np.hypot(width, height)
    k = np.asarray(lens(focal).coefficients) * unit ** (2.0 * np.arange(1, 3))
    told = {"units": "PIXELS", "sensor_width": 36.0, "focal_length_pixels": 1000.0}
    told["principal_point_pixels"] = [float(x), float(height - y)]
    return told | {"distortion_model": "NUKE", "nuke_k1": float(k[0]), "nuke_k2": float(k[1])}, 0.0


def two_terms():
    rows = [[0.02, -0.001], [-0.07, 0.004]]
    return polynomial(rows, (640, 480), (325.0, 236.0), distortion_model=Division())


MODELS = {
    **{name: LENSES[name] for name in ("landscape", "portrait", "wide, three terms", "px", "smooth")},
    **{name: LENSES[name] for name in ("decentred", "moving centre")},
    "division, two terms": two_terms,
}


def shifted(found, lens, method, back):
    """The greatest difference after the whole pixels by which Blender's node moves its result."""
    at = grid(found)
    inside = ((found[..., :2] > 20) & (found[..., :2] < np.array(lens.image_size) - 21)).all(-1)
    moved = np.median((np.asarray(back(found[..., :2])) - at)[inside], axis=0)
    assert moved == pytest.approx(np.round(moved), abs=0.02)
    wanted = np.asarray(method(at + np.round(moved)))
    full = (found[..., 2] > 0.999)[..., None]  # what lies beyond the image is transparent
    return np.round(moved) + 0.0, difference(
        np.where(full, found[..., :2], wanted), wanted, lens.image_size
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_blender_distorts_by_a_clips_camera(name, tmp_path):
    lens, ours = MODELS[name](), python()
    focal = float(np.asarray(lens.focal_range)[0])
    distortion = lens(focal)
    told, reported = nuke_camera(lens, focal) if "two" in name else camera(lens, tmp_path / "a.json", focal)
    ramp = of_coordinates(tmp_path / "ramp.exr", lens.image_size)
    job = {"image": ramp, "camera": told, "size": lens.image_size}
    run(
        ours,
        RENDER,
        [job | {"type": way, "out": f"{tmp_path}/{way}.exr"} for way in ("Undistort", "Distort")],
    )
    for way, there, back in (
        ("Undistort", distortion.distort, distortion.undistort),
        ("Distort", distortion.undistort, distortion.distort),
    ):
        moved, worst = shifted(opened(tmp_path / f"{way}.exr")[0], lens, there, back)
        print(f"| {name} | {told['distortion_model']}, {way} | {reported:.2g} | {worst:.2g} | {moved} |")
        # The report is of distorted points; correction stretches by a third at most here.
        assert worst <= 1.4 * reported + MARGIN
