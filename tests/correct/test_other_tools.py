"""Photographs and videos before and after correction, as exiftool and ffprobe see them, where installed."""

import json
import shutil
import subprocess

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

import zoomjax as zj
from zoomjax.correct.video import undistort_video

from .._clips import SIZE, lens

PHOTO = (192, 128)

exiftool = pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool is not installed")
ffmpeg = pytest.mark.skipif(
    shutil.which("ffmpeg") is None or shutil.which("ffprobe") is None,
    reason="ffmpeg and ffprobe are not installed",
)

TAGS = {
    "EXIF": {
        "Make": "NIKON CORPORATION",
        "Model": "NIKON D90",
        "LensModel": "18-200",
        "FocalLength": 35,
        "ExposureTime": 0.008,
        "FNumber": 5.6,
        "ISO": 200,
        "DateTimeOriginal": "2020:01:02 03:04:05",
        "Orientation#": 3,
        "Copyright": "somebody",
        "UserComment": "straight äö",
        "GPSLatitude": 48.1,
        "GPSLatitudeRef": "N",
        "GPSLongitude": 11.5,
        "GPSLongitudeRef": "E",
    },
    "XMP": {"Creator": "Somebody", "Subject": "lines", "Rating": 4},
    "IPTC": {"Caption-Abstract": "A ruler", "Keywords": "lines", "City": "Linz"},
}

OF_THE_FILE = {"SourceFile", "System", "File", "ExifTool", "Composite", "QuickTime", "RIFF", "JFIF", "Meta"}
"""Groups of exiftool's that tell how pixels are stored."""

STORED = {
    "PNG:ProfileName",
    *(f"IFD0:{name}" for name in ("Compression", "Predictor", "RowsPerStrip")),
    *(f"IFD0:{name}" for name in ("StripByteCounts", "StripOffsets")),
}


def tags(path):
    done = subprocess.run(["exiftool", "-json", "-G1", "-a", "-n", str(path)], capture_output=True)
    return {
        name: value
        for name, value in json.loads(done.stdout)[0].items()
        if name.split(":")[0] not in OF_THE_FILE and name not in STORED
    }


def photo(path, rng):
    """A photo that Pillow writes, with tags that exiftool writes."""
    if path.suffix == ".heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    noise = (rng.random((PHOTO[1], PHOTO[0], 3)) * 255).astype(np.uint8)
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    dpi = {"dpi": (300, 300)} if path.suffix in (".jpg", ".png", ".tif") else {}
    Image.fromarray(cv2.GaussianBlur(noise, (0, 0), 3)).save(path, icc_profile=profile, **dpi)
    given = [f"-{group}:{name}={value}" for group, of in TAGS.items() for name, value in of.items()]
    subprocess.run(["exiftool", "-q", "-q", "-m", "-overwrite_original", *given, str(path)], check=True)
    return path


@exiftool
@pytest.mark.filterwarnings("default")  # of formats that lack something: what is lost is compared here
@pytest.mark.parametrize(
    ("suffix", "target", "expected"),
    [
        (".jpg", ".jpg", {}),
        (".png", ".png", {}),
        (".tif", ".tif", {}),
        (".webp", ".webp", {}),
        # There, properties of the file turn the picture, and here are none.
        (".avif", ".avif", {"IFD0:Orientation": 1}),
        (".heic", ".jpg", {"IFD0:Orientation": 1}),
        (".jpg", ".tif", {}),
        (".tif", ".jpg", {}),
    ],
)
def test_exiftool_finds_the_same_tags(tmp_path, rng, suffix, target, expected):
    source = photo(tmp_path / f"in{suffix}", rng)
    zoom = zj.scenes.nikkor_18_200(PHOTO)
    zj.undistort_photo(source, tmp_path / f"out{target}", lens=zoom)  # 35 mm, from the EXIF data
    before, after = tags(source), tags(tmp_path / f"out{target}")
    assert before["ExifIFD:FocalLength"] == 35
    assert len(before) > 40
    assert after.pop("XMP-zoomjax:Geometry") == "undistorted"
    assert after.pop("XMP-zoomjax:Version")
    differ = {name: after.get(name) for name, value in before.items() if after.get(name) != value}
    stored = ("ImageWidth", "ImageHeight", "BitsPerSample", "PlanarConfiguration", "SamplesPerPixel")
    stored += ("PhotometricInterpretation", "SampleFormat", "SubfileType", "YCbCrPositioning")
    differ = {name: value for name, value in differ.items() if name.split(":")[1] not in stored}
    assert differ == expected


CHAPTERS = """;FFMETADATA1
title=A clip
artist=Somebody
[CHAPTER]
TIMEBASE=1/1000
START=0
END=300
title=Wide
[CHAPTER]
TIMEBASE=1/1000
START=300
END=960
title=Long
"""
TEXT = "1\n00:00:00,100 --> 00:00:00,500\nStraight\n\n"
RICH = "-map_metadata 3 -map_chapters 3 -map 0 -map 1 -map 2 -metadata:s:s:0 language=deu"
COLOUR = "-colorspace bt709 -color_primaries bt709 -color_trc bt709 -color_range tv"
MASTERING = "G(13250,34500)B(7500,3000)R(34000,16000)WP(15635,16450)L(10000000,1):max-cll=1000,400"
HDR = (
    "-c:v libx265 -pix_fmt yuv420p10le -color_primaries bt2020 -color_trc smpte2084 -colorspace bt2020nc "
    "-x265-params log-level=none:hdr-opt=1:repeat-headers=1:colorprim=bt2020:transfer=smpte2084"
    f":colormatrix=bt2020nc:master-display={MASTERING}"
)
CLIPS = {
    "in.mp4": f"{RICH} -c:v libx264 -pix_fmt yuv420p -c:a aac -c:s mov_text {COLOUR}",
    "in.mkv": f"{RICH} {HDR} -c:a libopus -c:s srt -metadata:s:v:0 title=left",
    "in.mov": "-map 0 -map 1 -c:v prores_ks -profile:v 2 -pix_fmt yuv422p10le -c:a pcm_s16le "
    "-timecode 01:02:03:04 -metadata title=clip",
    "in.ts": "-map 0 -map 1 -c:v libx264 -pix_fmt yuv420p -c:a aac",
    "in.webm": "-map 0 -map 1 -c:v libvpx-vp9 -c:a libopus -metadata title=clip",
    "in.avi": "-map 0 -map 1 -c:v libx264 -pix_fmt yuv420p -c:a mp3 -metadata title=clip",
}

VARYING = {
    *("filename", "size", "bit_rate", "max_bit_rate", "extradata_size", "probe_score", "duration"),
    *("duration_ts", "nb_frames", "avg_frame_rate", "start_pts", "start_time", "encoder", "ENCODER"),
    *("DURATION", "software", "bits_per_raw_sample", "has_b_frames", "level"),
}
"""What an encoder or a muxer may tell otherwise of the same pictures."""

UNKNOWN = {"field_order": "progressive", "sample_aspect_ratio": "1:1", "display_aspect_ratio": "5:3"}
"""What may be untold: it is usual."""


def probed(path):
    show = ["-show_streams", "-show_format", "-show_chapters"]
    done = subprocess.run(["ffprobe", "-v", "error", "-of", "json", *show, str(path)], capture_output=True)
    return dict(_leaves(json.loads(done.stdout)))


def _leaves(node, path=()):
    if not isinstance(node, dict | list):
        yield path, node
        return
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        yield from _leaves(value, (*path, key))


def make_clip(path):
    (path.parent / "text.srt").write_text(TEXT)
    (path.parent / "about.txt").write_text(CHAPTERS)
    made = [
        *f"-f lavfi -i testsrc2=size={SIZE[0]}x{SIZE[1]}:rate=25:duration=1".split(),
        *["-f", "lavfi", "-i", "sine=duration=1"],
        *("-i", path.parent / "text.srt", "-i", path.parent / "about.txt"),
    ]
    options = ["-map_chapters", "-1"] if RICH not in CLIPS[path.name] else []
    command = ["ffmpeg", "-y", "-loglevel", "error", *made, *options, *CLIPS[path.name].split(), path]
    subprocess.run([str(word) for word in command], check=True)
    return path


@ffmpeg
@pytest.mark.parametrize("name", CLIPS)
def test_ffprobe_finds_the_same_streams(tmp_path, name):
    source = make_clip(tmp_path / name)
    target = source.with_stem("out")
    done = undistort_video(source, target, lens=lens(), focal=20.0)
    assert done.not_kept == ()
    before, after = probed(source), probed(target)
    assert len(before) > 60
    differ = {
        ".".join(map(str, path)): (before.get(path), after.get(path))
        for path in before.keys() | after.keys()
        if before.get(path) != after.get(path) and path[-1] not in VARYING
    }
    for name, (was, is_now) in list(differ.items()):
        if is_now is None and UNKNOWN.get(name.rpartition(".")[2]) == was:
            del differ[name]
    if source.suffix == ".mov":  # FFmpeg's own name of a time code
        differ.pop("streams.2.tags.handler_name")
    assert differ == {}
    if RICH in CLIPS[source.name]:
        chapters = [value for path, value in after.items() if path[0] == "chapters" and path[-1] == "title"]
        assert chapters == ["Wide", "Long"]
