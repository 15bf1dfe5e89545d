"""How fast images, photos and video are corrected, beside OpenCV and FFmpeg.

    python -m benchmarks.correct [--frames N] [--output FILE]

A lens from barrel to pincushion over 20-80 mm, another focal length at every call or frame. Everything in
one process, taking turns, so that all see the same disturbances; medians of times (lower is better), and
medians of the ratios within a round. FFmpeg, for its static `lenscorrection`, is a process of its own, and
is left out where there is none. Accuracy stands beside time. Results go to benchmarks/results/correct.md
and correct.json.
"""

import argparse
import importlib.metadata
import itertools
import json
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import cv2
import jax
import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax.correct._prefetch import ahead
from zoomjax.correct.image import position_map
from zoomjax.correct.maps import OUTSIDE
from zoomjax.correct.video import undistort_video

from .shared import RESULTS, machine, write

HD, PHOTO = (1920, 1080), (4000, 3000)
FLAGS = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC}

CUBIC_RIVAL = "OpenCV's map and remap, cubic"


def zoom_lens(size: tuple[int, int]) -> zj.ZoomLens:
    """Corners move out by 12 % at 20 mm, in by 2 % at 80 mm."""
    zoom = zj.PolynomialZoom(
        degree=1, parameters=jnp.array([[-0.067, 0.013], [0.187, -0.013]]), focal_ref=jnp.array(20.0)
    )
    return zj.ZoomLens(zoom, (jnp.array(size) - 1) / 2, jnp.array([20.0, 80.0]), size)


def picture(size: tuple[int, int], seed: int = 0) -> Any:
    """Blurred noise with lines across it: (height, width, 3) bytes."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.uniform(0, 1, (size[1], size[0], 3)).astype(np.float32), (0, 0), 3)
    image = (255 * (noise - noise.min()) / np.ptp(noise)).astype(np.uint8)
    for _ in range(100):
        ends = rng.uniform(0, 1, (2, 2)) * size
        colour = rng.uniform(0, 255, 3).tolist()
        cv2.line(image, tuple(map(int, ends[0])), tuple(map(int, ends[1])), colour, 3)
    return image


def in_turn(functions: dict[str, Callable], rounds: int) -> dict[str, list[float]]:
    """Seconds of each function in each round, after a first call that does not count."""
    for function in functions.values():
        jax.block_until_ready(function())
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function())
            times[name].append(time.perf_counter() - start)
    return times


def summary(times: dict[str, list[float]], ratios: dict[str, tuple[str, str]]) -> dict:
    """Medians of the times in ms, and of the ratios of two of them within a round."""
    return {
        "ms": {name: 1e3 * statistics.median(values) for name, values in times.items()},
        "ratio": {
            name: statistics.median(a / b for a, b in zip(times[above], times[below], strict=True))
            for name, (above, below) in ratios.items()
        },
    }


def stills(size: tuple[int, int], rounds: int) -> dict:
    """`undistort_image` against `cv2.remap` alone, and OpenCV's own map with remap."""
    lens, image = zoom_lens(size), picture(size)
    distortions = itertools.cycle([lens(f) for f in 1 / np.linspace(1 / 20, 1 / 80, 50)])
    x, y = position_map(lens(20.0), zj.correct.frame_output(lens, size), size)
    scale = float(lens.scale)
    camera = np.array([[scale, 0, (size[0] - 1) / 2], [0, scale, (size[1] - 1) / 2], [0, 0, 1]])

    def opencv(flag: int):
        k = np.asarray(next(distortions).coefficients)
        model = np.array([-k[0], 3 * k[0] ** 2 - k[1], 0, 0])  # its model is the inverse, to second order
        maps = cv2.initUndistortRectifyMap(camera, model, None, camera, size, cv2.CV_16SC2)
        return cv2.remap(image, *maps, flag)

    functions, ratios = {}, {}
    for name, flag in FLAGS.items():
        functions[f"remap, {name}"] = lambda flag=flag: cv2.remap(image, x, y, flag)
        functions[f"OpenCV's map and remap, {name}"] = lambda flag=flag: opencv(flag)
        functions[f"undistort_image, {name}"] = lambda name=name: zj.undistort_image(
            image, next(distortions), interpolation=name
        )
        ratios[f"{name}, of remap"] = (f"undistort_image, {name}", f"remap, {name}")
        ratios[f"{name}, of OpenCV's map and remap"] = (
            f"undistort_image, {name}",
            f"OpenCV's map and remap, {name}",
        )
    return summary(in_turn(functions, rounds), ratios) | {"error_px": map_error(lens, size)}


def map_error(lens: zj.ZoomLens, size: tuple[int, int]) -> float:
    """The largest distance of the map to the exact inverse, px, at nine focal lengths."""
    framing = zj.correct.frame_output(lens, size)
    pixels = np.stack(np.meshgrid(*map(np.arange, size)), axis=-1).astype(float)
    worst = 0.0
    for focal in 1 / np.linspace(1 / 20, 1 / 80, 9):
        x, y = position_map(lens(focal), framing, size)
        exact = np.asarray(lens(focal).distort(pixels))
        seen = (x != OUTSIDE) & (exact >= 0).all(-1) & (exact <= np.array(size) - 1).all(-1)
        worst = max(worst, float(np.hypot(x - exact[..., 0], y - exact[..., 1])[seen].max()))
    return worst


def differentiable(size: tuple[int, int], rounds: int) -> dict:
    """`warp_image` and its gradients, float32, against `cv2.remap` of bytes and of float32."""
    lens = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), zoom_lens(size))
    image = picture(size)
    single = image.astype(np.float32)
    array, brightness = jnp.asarray(image), jnp.asarray(single)
    distortions = itertools.cycle([lens(f) for f in 1 / np.linspace(1 / 20, 1 / 80, 50)])
    x, y = position_map(lens(20.0), zj.correct.frame_output(lens, size), size)

    def loss(distortion, image):
        return jnp.sum(zj.warp_image(image, distortion) ** 2)

    by_lens, by_both = jax.jit(jax.grad(loss)), jax.jit(jax.grad(loss, argnums=(0, 1)))
    functions = {
        "remap, uint8": lambda: cv2.remap(image, x, y, cv2.INTER_LINEAR),
        "remap, float32": lambda: cv2.remap(single, x, y, cv2.INTER_LINEAR),
        "warp_image, uint8": lambda: zj.warp_image(array, next(distortions)),
        "warp_image, float32": lambda: zj.warp_image(brightness, next(distortions)),
        "gradient, lens": lambda: by_lens(next(distortions), brightness),
        "gradient, lens and image": lambda: by_both(next(distortions), brightness),
    }
    ratios = {
        "uint8 of remap": ("warp_image, uint8", "remap, uint8"),
        "float32 of remap": ("warp_image, float32", "remap, float32"),
        "gradient, lens, of forward": ("gradient, lens", "warp_image, float32"),
        "gradient, lens and image, of forward": ("gradient, lens and image", "warp_image, float32"),
    }
    return summary(in_turn(functions, rounds), ratios)


def write_clip(path: Path, frames: int) -> None:
    """A zoom into a picture, 1080p H.264, 30 frames/s."""
    big = picture((3840, 2160))
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=30, options={"crf": "18", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = *HD, "yuv420p"
        for number in range(frames):
            scale = 0.95 - 0.4 * number / frames
            affine = np.array([[scale * 2, 0, 1920 * (1 - scale)], [0, scale * 2, 1080 * (1 - scale)]])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            view: Any = cv2.warpAffine(big, affine, HD, flags=flags)
            frame = av.VideoFrame.from_ndarray(view, "bgr24")
            output.mux(stream.encode(frame.reformat(format="yuv420p")))
        output.mux(stream.encode(None))


def pass_through(source: Path, target: Path, options: dict[str, str]) -> None:
    """Decode and encode with nothing in between, in two threads as `undistort_video` has them."""
    with av.open(str(source)) as given, av.open(str(target), "w") as output:
        video = given.streams.video[0]
        video.thread_type = "AUTO"
        stream = output.add_stream("libx264", rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = *HD, "yuv420p"
        for frame in ahead(frame for frame in given.decode(video)):
            frame.pict_type = 0
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))


def video(frames: int, rounds: int) -> dict:
    """Frames/s of correcting a clip, against no correction, and FFmpeg without and with its filter."""
    lens, results = zoom_lens(HD), {}
    track = zj.io.FocalTrack(np.array([0.0, frames - 1]), np.array([20.0, 80.0]), by_time=False)
    ffmpeg = shutil.which("ffmpeg")
    with tempfile.TemporaryDirectory() as name:
        source, target = Path(name) / "in.mp4", Path(name) / "out.mp4"
        write_clip(source, frames)

        def filtered(preset: str, *arguments: str) -> None:
            command = [str(ffmpeg), "-v", "error", "-y", "-i", str(source), *arguments]
            encoder = ["-c:v", "libx264", "-crf", "18", "-preset", preset, str(target)]
            subprocess.run([*command, *encoder], check=True)

        for preset in ("medium", "veryfast", "ultrafast"):
            options = {"crf": "18", "preset": preset}
            functions = {
                "no correction": lambda options=options: pass_through(source, target, options),
                "undistort_video": lambda options=options: undistort_video(
                    source, target, lens=lens, focal=track, options=options
                ),
            }
            if ffmpeg:
                functions["ffmpeg, no correction"] = lambda preset=preset: filtered(preset)
                functions["ffmpeg, lenscorrection"] = lambda preset=preset: filtered(
                    preset, "-vf", "lenscorrection=k1=-0.1:k2=0.01:i=bilinear"
                )
            times: dict[str, list[float]] = {key: [] for key in functions}
            for _ in range(rounds):
                for key, function in functions.items():
                    start = time.perf_counter()
                    function()
                    times[key].append(time.perf_counter() - start)
            ratios = {"of no correction": ("no correction", "undistort_video")}
            if ffmpeg:
                ratios["ffmpeg's filter of none"] = ("ffmpeg, no correction", "ffmpeg, lenscorrection")
            results[preset] = {
                "frames_per_s": {key: frames / statistics.median(t) for key, t in times.items()},
                "ratio": summary(times, ratios)["ratio"],
            }
            print(preset, json.dumps(results[preset], indent=1), flush=True)
    return results | {"frames": frames, "ffmpeg": version_of(ffmpeg)}


def version_of(ffmpeg: str | None) -> str | None:
    if ffmpeg is None:
        return None
    done = subprocess.run([ffmpeg, "-version"], capture_output=True, text=True, check=True)
    return done.stdout.split()[2]


def markdown(r: dict) -> str:
    """The results as a page."""
    m = r["machine"]

    def verdict(value: float, asked: float, least: bool = False) -> str:
        met = value >= asked if least else value <= asked
        return f"{value:.2f} | {'≥' if least else '≤'} {asked:g} | {'yes' if met else 'no'}"

    still, photo, jax_ = r["stills"]["ratio"], r["photo"]["ratio"], r["jax"]["ratio"]
    rows = [
        *(
            (f"1080p, {name}: undistort_image / remap", verdict(still[f"{name}, of remap"], 1.3))
            for name in FLAGS
        ),
        *(
            (
                f"1080p, {name}: undistort_image / OpenCV's map and remap",
                verdict(still[f"{name}, of OpenCV's map and remap"], 0.75),
            )
            for name in FLAGS
        ),
        *(
            (f"12 MP, {name}: undistort_image / remap", verdict(photo[f"{name}, of remap"], 1.5))
            for name in FLAGS
        ),
        ("warp_image / remap, uint8", verdict(jax_["uint8 of remap"], 3)),
        ("warp_image / remap, float32", verdict(jax_["float32 of remap"], 3)),
        ("gradient by the lens / forward", verdict(jax_["gradient, lens, of forward"], 4)),
        (
            "gradient by lens and image / forward",
            verdict(jax_["gradient, lens and image, of forward"], 6),
        ),
        *(
            (
                f"undistort_video / no correction, frame rate, {preset}",
                verdict(r["video"][preset]["ratio"]["of no correction"], 0.75, least=True),
            )
            for preset in ("medium", "veryfast", "ultrafast")
        ),
    ]
    floor = r["stills"]["ms"]["remap, cubic"] / r["stills"]["ms"][CUBIC_RIVAL]
    rivals = list(r["video"]["medium"]["frames_per_s"])
    ffmpeg = r["video"]["ffmpeg"]
    return "\n".join(
        [
            "# Correcting",
            "",
            "`python -m benchmarks.correct`: another focal length at every call or frame. Medians; ratios "
            "are medians of the ratios within a round of turns.",
            "",
            f"{m['cpu']}, {m['cores']} cores, {m['memory_GB']} GB; Python {m['python']}, "
            f"jax {m['jax']}, OpenCV {m['opencv']}, PyAV {m['av']}, "
            f"ffmpeg {ffmpeg or 'absent, left out'}; on {m['device']}.",
            "",
            f"Positions of the maps: within {r['stills']['error_px']:.1e} px of the exact inverse at "
            f"1080p, {r['photo']['error_px']:.1e} px at 12 MP (float64 lens, float32 map).",
            "",
            "| ratio | measured | aim | met |",
            "|---|---:|---:|---|",
            *(f"| {name} | {text} |" for name, text in rows),
            "",
            "Cubic interpolation takes so long that no map, however cheap, comes below "
            f"{floor:.2f} of OpenCV's map and remap: remap alone takes that.",
            "",
            "| three channels | ms |",
            "|---|---:|",
            *(f"| 1080p uint8: {name} | {ms:.1f} |" for name, ms in r["stills"]["ms"].items()),
            *(f"| 12 MP uint8: {name} | {ms:.1f} |" for name, ms in r["photo"]["ms"].items()),
            *(f"| 1080p: {name} | {ms:.1f} |" for name, ms in r["jax"]["ms"].items()),
            "",
            f"Video: {r['video']['frames']} frames of 1080p H.264, decoded and encoded again by libx264 "
            "with crf 18; frames/s:",
            "",
            f"| preset | {' | '.join(rivals)} |",
            f"|---|{'---:|' * len(rivals)}",
            *(
                f"| {preset} | "
                + " | ".join(f"{r['video'][preset]['frames_per_s'][rival]:.1f}" for rival in rivals)
                + " |"
                for preset in ("medium", "veryfast", "ultrafast")
            ),
            "",
        ]
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=300, help="length of the clip")
    parser.add_argument("--rounds", type=int, default=21, help="turns of each still image's rivals")
    parser.add_argument("--output", type=Path, default=RESULTS / "correct.md")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    versions = {
        "opencv": cv2.__version__,
        "av": importlib.metadata.version("av"),
    }
    measured = {
        "machine": machine() | versions,
        "stills": stills(HD, given.rounds),
        "photo": stills(PHOTO, given.rounds // 3),
        "jax": differentiable(HD, given.rounds),
    }
    print(json.dumps(measured, indent=1), flush=True)
    measured["video"] = video(given.frames, rounds=2)
    write(given.output, markdown(measured), measured)
