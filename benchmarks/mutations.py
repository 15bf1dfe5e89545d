"""Files of every kind that zoomjax reads, and what a seeded generator makes of them.

For the tests, which try some hundreds of each, and for `reliability_fuzz`, which tries as many as one has
time for. A damaged file must be read as something sound, or refused by a sentence that
names it.
"""

import collections
import dataclasses
import functools
import io
import json
import math
import os
import struct
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

import zoomjax as zj
from zoomjax import scenes
from zoomjax.detect._workers import LostError, Workers
from zoomjax.detect.sources import Source, video_frames
from zoomjax.io.exif import exif_focal, exif_with_focal
from zoomjax.io.focal_table import read_focal_table
from zoomjax.io.photo import read_photo

TOKENS = (
    *(b",", b";", b"\n", b"\r", b'"', b"\x00", b"nan", b"inf", b"-1", b"1e400", b"9" * 400, b"[", b"{"),
    *(b"null", b"\xff", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x00\x00\x00\x00", b"\xff\xd8"),
)


def damaged(content: bytes, rng: np.random.Generator, other: bytes = b"") -> bytes:
    """A few changes: bytes changed, cut off, put in, taken out, doubled, or of another file."""
    for _ in range(int(rng.integers(1, 5))):
        if not content:
            return content
        low, high = np.sort(rng.integers(0, len(content) + 1, 2)).tolist()
        if rng.random() < 0.5:  # headers and numbers are short
            high = min(high, low + int(rng.integers(1, 9)))
        chunk = (
            TOKENS[rng.integers(len(TOKENS))] if rng.random() < 0.5 else rng.bytes(int(rng.integers(1, 9)))
        )
        match rng.integers(8):
            case 0 | 1:
                at = min(low, len(content) - 1)
                content = (
                    content[:at] + bytes([content[at] ^ (1 << int(rng.integers(8)))]) + content[at + 1 :]
                )
            case 2:
                content = content[:low] if rng.random() < 0.7 else content[low:]
            case 3:
                content = content[:low] + chunk + content[low:]
            case 4:
                content = content[:low] + content[high:]
            case 5:
                content = content[:high] + content[low:high] + content[high:]
            case 6:
                content = content[:low] + chunk + content[low + len(chunk) :]
            case 7:
                content = content[:low] + other[low:high] + content[high:]
    return content


@dataclasses.dataclass(frozen=True)
class Reader:
    """What reads a kind of file.

    Attributes:
        suffix: of its files.
        corpus: sound files of the kind, which must be read.
        read: reads one.
        sound: raises `AssertionError` if what was read is not sound.
        same: of formats with checksums: what may not differ from that of one of the sound files.
        share: of the files tried of other kinds, where reading one takes long.
    """

    suffix: str
    corpus: Callable[[Path], list[bytes]]
    read: Callable[[Path], Any]
    sound: Callable[[Any], None]
    same: Callable[[Any], bytes] | None = None
    share: float = 1.0


def outcome(reader: Reader, path: Path, content: bytes) -> str:
    """What becomes of a file: "read", "refused", "wrong: ..." or "crashed: ..."."""
    path.write_bytes(content)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            result = reader.read(path)
        except (ValueError, OSError) as error:
            if str(path) not in str(error):
                return f"wrong: the error does not name the file: {error}"
            return "refused" if len(told) < 10 else f"wrong: {len(told)} warnings"
        except Exception as error:
            return f"crashed: {type(error).__name__}: {error}"
    if len(told) >= 10:
        return f"wrong: {len(told)} warnings"
    try:
        reader.sound(result)
        assert reader.same is None or reader.same(result) in _corpus_of(reader), "other values than stored"
    except Exception as error:
        return f"wrong: {type(error).__name__}: {error}"
    return "read"


@functools.cache
def _corpus_of(reader: Reader) -> set[bytes]:
    """What may be read from files of a format with checksums."""
    assert reader.same is not None
    found = set()
    with tempfile.TemporaryDirectory() as folder:
        for content in reader.corpus(Path(folder)):
            path = Path(folder) / f"file{reader.suffix}"
            path.write_bytes(content)
            found.add(reader.same(reader.read(path)))
    return found


class Outcomes:
    """Of files, in processes that may die of them; begun once for all readers."""

    def __init__(self, number: int = 1, seconds: float = 60.0):
        self._folder = tempfile.TemporaryDirectory()
        self._workers = Workers(functools.partial(_tried, self._folder.name), number, seconds)

    def __enter__(self) -> "Outcomes":
        return self

    def __exit__(self, *exception) -> None:
        self._workers.__exit__(*exception)
        self._folder.cleanup()

    def of(self, name: str, contents: Iterable[bytes]) -> Iterator[tuple[bytes, str]]:
        """Each content, and what the reader of this name makes of it."""
        pending: collections.deque[tuple[bytes, Future]] = collections.deque()
        for content in contents:
            pending.append((content, self._workers.submit((name, content))))
            if len(pending) > 64:
                yield self._finished(*pending.popleft())
        while pending:
            yield self._finished(*pending.popleft())

    @staticmethod
    def _finished(content: bytes, result: Future) -> tuple[bytes, str]:
        try:
            return content, result.result()
        except LostError as error:
            return content, f"{'hung' if 'took more' in str(error) else 'crashed'}: {error}"


def _tried(folder: str, item: tuple[str, bytes]) -> str:
    name, content = item
    reader = READERS[name]
    return outcome(reader, Path(folder) / f"{os.getpid()}{reader.suffix}", content)


# What is read, and what is sound.


def _lines_files(folder: Path) -> list[bytes]:
    rng = np.random.default_rng(0)
    points = [rng.uniform(0, 60, (n, 2)) for n in (5, 3, 7, 4)]
    lines = zj.Lines.from_ragged(points, [0, 1, 1, 0], [20.0, 50.0], image_size=(64, 64))
    lines.weighted(np.ones(4)).save(folder / "sound.npz")
    with np.load(folder / "sound.npz") as file:
        fields = {name: file[name] for name in file.files}
    np.savez_compressed(folder / "packed.npz", **fields)
    rounded = [np.rint(line * 1024) / 1024 for line in points]  # which is stored in another way
    zj.Lines.from_ragged(rounded, [0, 1, 1, 0], [20.0, 50.0], image_size=(64, 64)).save(
        folder / "steps.npz"
    )
    plain = io.BytesIO()
    with zipfile.ZipFile(folder / "sound.npz") as given, zipfile.ZipFile(plain, "w") as stored:
        for member in given.infolist():  # without checksums that would catch a change: those are made again
            stored.writestr(member.filename, given.read(member))
    files = [(folder / f"{name}.npz").read_bytes() for name in ("sound", "packed", "steps")]
    return [*files, plain.getvalue()]


def sound_lines(lines: zj.Lines) -> None:
    """Finite points, three a line, positive focal lengths, and no frame without a line."""
    mask = np.asarray(lines.mask)
    assert np.isfinite(np.asarray(lines.points)[mask]).all()
    assert (mask.sum(1) >= 3).all()
    assert (np.isfinite(lines.focal) & (np.asarray(lines.focal) > 0)).all()
    assert set(np.unique(lines.frame)) == set(range(len(lines.focal)))
    assert lines.weight is None or np.isfinite(lines.weight).all()


def lines_values(lines: zj.Lines) -> bytes:
    """All that a fit uses."""
    used = (
        lines.points,
        lines.mask,
        lines.frame,
        lines.focal,
        lines.centre,
        lines.image_size,
        lines.weight,
    )
    return b"".join(np.asarray(field).tobytes() for field in used if field is not None)


def _tracks_files(folder: Path) -> list[bytes]:
    rng = np.random.default_rng(0)
    track, frame = np.repeat(np.arange(4), 3), np.tile(np.arange(3), 4)
    points = rng.uniform(0, 60, (12, 2))
    files = []
    for weight in (None, rng.uniform(0, 2, 12)):
        tracks = zj.tracks.Tracks.from_arrays(track, frame, points, image_size=(64, 64), weight=weight)
        tracks.save(folder / "tracks.npz")
        files.append((folder / "tracks.npz").read_bytes())
    return files


def sound_tracks(tracks: zj.tracks.Tracks) -> None:
    """Finite points, two a track, each in a frame of its own that there is, and weights of at least 0."""
    mask, frame = np.asarray(tracks.mask), np.asarray(tracks.frame)
    assert np.isfinite(np.asarray(tracks.points)[mask]).all()
    assert (mask.sum(1) >= 2).all()
    assert frame[mask].min() >= 0
    assert frame[mask].max() < tracks.frames
    weight = tracks.view_weights()
    assert weight is None or (np.isfinite(weight) & (weight >= 0)).all()
    assert all(len(set(row[there])) == there.sum() for row, there in zip(frame, mask, strict=True))


def tracks_values(tracks: zj.tracks.Tracks) -> bytes:
    """All that a fit uses."""
    used = (tracks.points, tracks.mask, tracks.frame, tracks.frames, tracks.image_size, tracks.weight)
    return b"".join(np.asarray(field).tobytes() for field in used if field is not None)


def read_tracks_csv(path: Path) -> zj.tracks.Tracks:
    """With the image size that a caller would give."""
    return zj.tracks.read_tracks_csv(path, image_size=(64, 64))


CSV_TRACKS = b"track,frame,x,y\n" + b"".join(
    b"%d,%d,%d.5,%d\n" % (n, m, 5 * n + m, 7 * m) for n in range(4) for m in range(3)
)


def every_model() -> list[zj.ZoomLens]:
    """A lens of each zoom model that has a file format."""
    lens, focal = scenes.nikkor_18_200((640, 427)), np.linspace(20.0, 120.0, 7)
    made = []
    for zoom in (
        zj.PolynomialZoom(),
        zj.models.TableZoom(number=3),
        zj.models.SplineZoom(number=4),
        zj.models.PowerZoom(),
        zj.models.TwoRegionZoom(crossover=60.0),
        zj.SmoothZoom(),
    ):
        made.append(dataclasses.replace(lens, zoom=zoom.prepare(focal, 2)))
    return [*made, dataclasses.replace(lens, shift=zj.PolynomialZoom(degree=1).prepare(focal, 2))]


def _lens_files(folder: Path) -> list[bytes]:
    contents = []
    for lens in every_model():
        lens.save(folder / "sound.json")
        contents.append((folder / "sound.json").read_bytes())
    return contents + [json.dumps(json.loads(content)).encode() for content in contents]


def sound_lens(lens: zj.ZoomLens) -> None:
    """Numbers everywhere: as they are stored, without the work of computing with them."""
    assert np.isfinite(lens.focal_range).all()
    assert (np.asarray(lens.focal_range) > 0).all()
    assert np.isfinite(lens.centre).all()
    assert np.isfinite(lens.zoom.parameters).all()
    assert min(lens.image_size) >= 1
    assert lens.focal_unit in ("mm", "px")


def sound_table(table: Any) -> None:
    """Positive focal lengths."""
    assert all(0 < table.need(name) < math.inf for name in table._focals)


def sound_track(track: Any) -> None:
    """A focal length where the track begins."""
    first = float(track.position[0])
    assert 0 < track.at(int(first), first) < math.inf


def sound_mapping(focal: dict[int, float]) -> None:
    """Frames and positive focal lengths."""
    assert all(isinstance(frame, int) and 0 < f < math.inf for frame, f in focal.items())


def read_lines_csv(path: Path) -> zj.Lines:
    """With the image size that the command line would be given."""
    return zj.lines.read_lines_csv(path, image_size=(64, 64))


CSV_LINES = b"frame,line,x,y,focal\n" + b"".join(
    b"%d,%d,%d.5,%d,2%d\n" % (m, n, i, i * i, m) for m in (0, 1) for n in (0, 1) for i in range(5)
)


def _exif_files(_: Path) -> list[bytes]:
    little = exif_with_focal(35.0)
    big = b"MM" + struct.pack(">HIHHHIII", 42, 8, 1, 0x8769, 4, 1, 26, 0)
    big += struct.pack(">HHHIII", 1, 0x920A, 5, 1, 44, 0) + struct.pack(">II", 350, 10)
    return [little, b"Exif\0\0" + little, big]


def _read_exif(path: Path) -> float | None:
    return exif_focal(path.read_bytes())


def sound_focal(focal: float | None) -> None:
    """None, or a positive number."""
    assert focal is None or 0 < focal < math.inf


def _image() -> np.ndarray:
    rng = np.random.default_rng(0)
    soft = cv2.GaussianBlur(rng.uniform(0, 255, (40, 56, 3)).astype(np.float32), (0, 0), 2)
    return np.rint(255 * (soft - soft.min()) / np.ptp(soft)).astype(np.uint8)


def _photo_files(suffix: str) -> Callable[[Path], list[bytes]]:
    def make(_: Path) -> list[bytes]:
        image, block = _image(), np.frombuffer(exif_with_focal(35.0), np.uint8)
        files = [cv2.imencode(suffix, image)[1], cv2.imencode(suffix, image[..., 0])[1]]
        if suffix in (".jpg", ".png", ".webp"):
            files.append(cv2.imencodeWithMetadata(suffix, image, [cv2.IMAGE_METADATA_EXIF], [block])[1])
        if suffix == ".jpg":
            files.append(cv2.imencode(suffix, image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1])
        if suffix in (".png", ".tif"):
            files.append(cv2.imencode(suffix, image.astype(np.uint16) * 200)[1])
        made = [file.tobytes() for file in files]
        for options in ({"compression": "jpeg"}, {"compression": "tiff_lzw"}, {"big_tiff": True}):
            if suffix == ".tif":
                stored = io.BytesIO()
                Image.fromarray(image).save(stored, "TIFF", **options)
                made.append(stored.getvalue())
        return made

    return make


def _read_photo(path: Path) -> tuple[tuple[np.ndarray, Any], np.ndarray]:
    return Source(path.name, path).read(), read_photo(path)[0]


def sound_photo(found: tuple[tuple[np.ndarray, float | None], np.ndarray]) -> None:
    """Bytes of one or three channels, and a focal length or none."""
    (image, focal), stored = found
    assert image.dtype == np.uint8
    assert image.shape[:2] == stored.shape[:2]
    assert image.ndim == 2 or image.shape[2] == 3
    assert image.size > 0
    sound_focal(focal)


def pixels(found: tuple[tuple[np.ndarray, float | None], np.ndarray]) -> bytes:
    """As they are stored."""
    return found[1].tobytes()


def _video_files(folder: Path) -> list[bytes]:
    import av

    made = []
    for suffix, encoder in ((".mp4", "libx264"), (".mkv", "libx264"), (".avi", "mpeg4")):
        path = folder / f"sound{suffix}"
        with av.open(str(path), "w") as out:
            video: Any = out.add_stream(encoder, rate=30)
            video.width, video.height, video.pix_fmt = 56, 40, "yuv420p"
            for number in range(5):
                frame = av.VideoFrame.from_ndarray(np.roll(_image(), number, 1), "bgr24")
                out.mux(video.encode(frame.reformat(format="yuv420p")))
            out.mux(video.encode(None))
        made.append(path.read_bytes())
    return made


def _read_video(path: Path) -> list[np.ndarray]:
    return [source.read()[0] for source in video_frames(path, 35.0, 5)]


def sound_frames(frames: list[np.ndarray]) -> None:
    """Some, of three channels."""
    assert frames
    assert all(frame.dtype == np.uint8 and frame.ndim == 3 and frame.shape[2] == 3 for frame in frames)


LCP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:stCamera="http://ns.adobe.com/photoshop/1.0/camera-profile"
 xmlns:photoshop="http://ns.adobe.com/photoshop/1.0/"><photoshop:CameraProfiles><rdf:Seq>
<rdf:li><rdf:Description stCamera:FocalLength="18" stCamera:FocusDistance="1" stCamera:ImageWidth="600"
 stCamera:ImageLength="400"><stCamera:PerspectiveModel><rdf:Description stCamera:FocalLengthX="0.5"
 stCamera:RadialDistortParam1="9"/></stCamera:PerspectiveModel></rdf:Description></rdf:li>
<rdf:li><rdf:Description stCamera:FocalLength="18" stCamera:FocusDistance="10" stCamera:ImageWidth="600"
 stCamera:ImageLength="400"><stCamera:PerspectiveModel><rdf:Description stCamera:FocalLengthX="0.8"
 stCamera:ImageXCenter="0.51" stCamera:ImageYCenter="0.49" stCamera:RadialDistortParam1="-0.1"
 stCamera:RadialDistortParam2="0.02"/></stCamera:PerspectiveModel></rdf:Description></rdf:li>
</rdf:Seq></photoshop:CameraProfiles></rdf:Description></rdf:RDF></x:xmpmeta>"""
"""An Adobe lens profile, of two focus distances."""


def _foreign(name: str, suffix: str) -> Reader:
    """Of lenses in another tool's format. Each is fitted anew, which takes a tenth of a second."""
    size, focal = (96, 64), (24, 35, 60)
    told: dict[str, Any] = {
        "lensfun": {"image_size": size},
        "nuke": {"image_size": size, "focal": focal},
        "pftrack": {"focal": focal},
        "discorpy": {"image_size": size, "focal": focal[:1]},
        "lcp": {},
    }

    def corpus(folder: Path) -> list[bytes]:
        if name == "lcp":
            return [LCP.encode()]
        made = folder / f"sound-{name}"
        zj.interop.write(scenes.nikkor_18_200(size), made, format=name, focal=focal, pixel_pitch=0.05)
        return [path.read_bytes() for path in (sorted(made.iterdir()) if made.is_dir() else [made])]

    def read(path: Path) -> zj.ZoomLens:
        return zj.interop.read(path, format=name, **told.get(name, {})).lens

    return Reader(suffix, corpus, read, sound_lens, share=0.01)


def _constant(*contents: bytes) -> Callable[[Path], list[bytes]]:
    return lambda _: list(contents)


READERS = {
    "lines.npz": Reader(".npz", _lines_files, zj.load_lines, sound_lines, lines_values),
    "lens.json": Reader(".json", _lens_files, zj.load_lens, sound_lens),
    "lines CSV": Reader(".csv", _constant(CSV_LINES), read_lines_csv, sound_lines),
    "tracks.npz": Reader(".npz", _tracks_files, zj.tracks.load_tracks, sound_tracks, tracks_values),
    "tracks CSV": Reader(".csv", _constant(CSV_TRACKS), read_tracks_csv, sound_tracks),
    "focal CSV": Reader(
        ".csv", _constant(b"frame,focal\n0,20\n1,35.5\n7,5e1\n"), zj.lines.read_focal_csv, sound_mapping
    ),
    "focal table": Reader(
        ".csv",
        _constant(b"image,focal,sigma\na.jpg,20,0.3\nb/c.jpg,35.5,\n", b"image,focal\na.jpg,20\n"),
        read_focal_table,
        sound_table,
    ),
    "focal track": Reader(
        ".csv",
        _constant(b"time,focal\n0,20\n0.5,30\n2,5e1\n", b"frame,focal\n0,20\n5,30\n"),
        zj.io.read_focal_track,
        sound_track,
    ),
    "EXIF": Reader(".exif", _exif_files, _read_exif, sound_focal),
    "JPEG": Reader(".jpg", _photo_files(".jpg"), _read_photo, sound_photo),
    "PNG": Reader(".png", _photo_files(".png"), _read_photo, sound_photo, pixels),
    "WebP": Reader(".webp", _photo_files(".webp"), _read_photo, sound_photo),
    "TIFF": Reader(".tif", _photo_files(".tif"), _read_photo, sound_photo),
    "BMP": Reader(".bmp", _photo_files(".bmp"), _read_photo, sound_photo),
    "video": Reader(".mp4", _video_files, _read_video, sound_frames),
    **{fmt.name: _foreign(fmt.name, fmt.suffixes[0]) for fmt in zj.interop.formats()},
}
