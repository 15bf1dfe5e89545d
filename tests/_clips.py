"""Rendered clips: straight edges seen through a lens that zooms, with sound."""

from fractions import Fraction

import av
import jax.numpy as jnp
import numpy as np

import zoomjax as zj

SIZE, FRAMES = (320, 192), 24
TICK = Fraction(1, 15360)
EDGES = np.arange(-120, 121, 48)
SLOPE = 0.15


def lens(size=SIZE):
    """Barrel at 20 mm, pincushion at 80 mm, by 48 and 9 px in the corners."""
    zoom = zj.PolynomialZoom(1, jnp.array([[-0.17, 0.02], [0.43, -0.02]]), jnp.array(20.0))
    return zj.ZoomLens(zoom, (jnp.array(size) - 1) / 2, jnp.array([20.0, 80.0]), size)


def focal(number):
    """Of a frame: linear in 1/f, as a track between the ends is."""
    return 1 / np.interp(number, [0, FRAMES - 1], [1 / 20, 1 / 80])


def picture(number):
    """Slanted bands, straight in the scene, as the lens shows them: (height, width) in 20 ... 230."""
    d = lens()(float(focal(number)))
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).astype(float)
    seen = np.asarray(d.undistort(pixels)) - np.asarray(d.centre)
    across = seen[..., 0] - SLOPE * seen[..., 1]
    profile = sum((-1) ** i * np.tanh(across - e) for i, e in enumerate(EDGES)) - 1
    return np.rint(125 + 80 * profile).astype(np.uint8)


def write_clip(path, frames=FRAMES, *, encoder="libx264", pixels="yuv420p", variable=False, sound=True):
    """A clip of `picture`s: BT.709, limited range, 30 frames/s, or variable; a tone of 48 kHz."""
    with av.open(str(path), "w") as out:
        options = {"libx264": {"crf": "6", "preset": "veryfast"}, "mpeg4": {"b": "8000000"}}.get(
            encoder, {}
        )
        video = out.add_stream(encoder, rate=30, options=options)
        video.width, video.height = SIZE
        video.pix_fmt = pixels
        context = video.codec_context
        context.time_base = TICK
        context.color_primaries = context.color_trc = context.colorspace = context.color_range = 1
        audio = out.add_stream("aac", rate=48000) if sound else None
        for number in range(frames):
            grey = av.VideoFrame.from_ndarray(picture(number), "gray").reformat(format=pixels)
            grey.pts, grey.time_base = 512 * number + (180 if variable and number % 2 else 0), TICK
            out.mux(video.encode(grey))
        out.mux(video.encode(None))
        if audio is not None:
            for block in range(frames * 1600 // 1024):
                time = (np.arange(1024) + 1024 * block) / 48000
                samples = (0.1 * np.sin(2 * np.pi * 440 * time)).astype(np.float32)[None]
                tone = av.AudioFrame.from_ndarray(samples, "fltp", layout="mono")
                tone.sample_rate, tone.pts, tone.time_base = 48000, 1024 * block, Fraction(1, 48000)
                out.mux(audio.encode(tone))
            out.mux(audio.encode(None))
    return path


def write_frames(path, frames, *, encoder="libx264", options=None):
    """A clip of blue, green, red frames, 30 a second, at the encoder's own quality."""
    with av.open(str(path), "w") as out:
        video = None
        for frame in frames:
            if video is None:
                video = out.add_stream(encoder, rate=30, options=options or {})
                video.height, video.width = frame.shape[:2]
                video.pix_fmt = "yuv420p"
            out.mux(video.encode(av.VideoFrame.from_ndarray(frame, "bgr24")))
        out.mux(video.encode(None))
    return path


def write_still(path, frames):
    """One picture over and over, as a video of any length at no cost."""
    one = write_clip(path.with_name("one.mkv"), 1, encoder="ffv1", sound=False)
    with av.open(str(one)) as given, av.open(str(path), "w") as out:
        [packet] = [p for p in given.demux(video=0) if p.size]
        stream = out.add_stream_from_template(given.streams.video[0])
        content = bytes(packet)
        for number in range(frames):
            again = av.Packet(content)
            again.stream, again.pts, again.dts = stream, 33 * number, 33 * number
            again.time_base, again.is_keyframe = packet.time_base, True
            out.mux(again)
    one.unlink()
    return path


def cut_off(clip, path):
    """The clip's pictures with the index in front, less the last third of the file."""
    with av.open(str(clip)) as given, av.open(str(path), "w", options={"movflags": "faststart"}) as out:
        stream = out.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    whole = path.read_bytes()
    path.write_bytes(whole[: 2 * len(whole) // 3])
    return path


def bend(grey):
    """The farthest that the edges of a picture lie from their own straight lines, px."""
    farthest = 0.0
    height, width = grey.shape
    middle = np.median(grey[grey > 60]) / 2 + np.median(grey[grey <= 120]) / 2
    for e in EDGES[1:-1]:
        points = []
        for row in range(24, height - 24, 4):
            about = (width - 1) / 2 + e + SLOPE * (row - (height - 1) / 2)
            columns = np.arange(int(about) - 14, int(about) + 15)
            step = grey[row, columns].astype(float) - middle
            crossing = np.flatnonzero(step[:-1] * step[1:] < 0)
            if len(crossing):
                i = crossing[np.argmin(abs(columns[crossing] - about))]
                points.append([row, columns[i] + step[i] / (step[i] - step[i + 1])])
        rows, found = np.array(points).T
        assert len(rows) > 30
        farthest = max(farthest, np.abs(np.polyval(np.polyfit(rows, found, 1), rows) - found).max())
    return farthest


def luma(path):
    """All frames' Y planes and times."""
    with av.open(str(path)) as container:
        frames = [(f.reformat(format="gray").to_ndarray(), f.time) for f in container.decode(video=0)]
    return np.stack([f for f, _ in frames]), np.array([t for _, t in frames])
