"""Where files of video should end, by the sizes of their parts."""

import struct

import pytest

from zoomjax.io.video_report import is_cut_off

MP4, MATROSKA = "mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm"
FTYP = struct.pack(">I4s", 16, b"ftyp") + bytes(8)
HEAD = b"\x1a\x45\xdf\xa3" + b"\x84" + bytes(4)
SEGMENT = b"\x18\x53\x80\x67"
WHOLE = {
    "a box": (MP4, FTYP + struct.pack(">I4s", 40, b"mdat") + bytes(32)),
    "a box of 64 bits": (MP4, FTYP + struct.pack(">I4sQ", 1, b"mdat", 48) + bytes(32)),
    "several boxes": (MP4, FTYP + 3 * (struct.pack(">I4s", 40, b"moof") + bytes(32))),
    "a size of a byte": (MATROSKA, HEAD + SEGMENT + b"\xa0" + bytes(32)),
    "a size of eight bytes": (MATROSKA, HEAD + SEGMENT + b"\x01" + (32).to_bytes(7) + bytes(32)),
    "a chunk": ("avi", struct.pack("<4sI", b"RIFF", 32) + bytes(32)),
    "two chunks": ("avi", 2 * (struct.pack("<4sI", b"RIFF", 32) + bytes(32))),
}
ENDLESS = {
    "a box to the end": (MP4, FTYP + struct.pack(">I4s", 0, b"mdat") + bytes(32)),
    "a live recording": (MATROSKA, HEAD + SEGMENT + b"\xff" + bytes(32)),
    "one of eight bytes": (MATROSKA, HEAD + SEGMENT + b"\x01" + b"\xff" * 7 + bytes(32)),
    "a transport stream": ("mpegts", b"\x47" + bytes(187)),
}


@pytest.mark.parametrize("case", WHOLE)
def test_a_file_ends_where_its_last_part_does(case, tmp_path):
    kind, content = WHOLE[case]
    path = tmp_path / "video"
    for missing in (0, 3, 20):
        path.write_bytes(content[: len(content) - missing])
        assert is_cut_off(path, kind) == bool(missing)
    path.write_bytes(content + b"more of another kind")
    assert not is_cut_off(path, kind)


@pytest.mark.parametrize("case", ENDLESS)
def test_a_file_whose_parts_tell_no_size_ends_anywhere(case, tmp_path):
    kind, content = ENDLESS[case]
    path = tmp_path / "video"
    for missing in (0, 3, 20):
        path.write_bytes(content[: len(content) - missing])
        assert not is_cut_off(path, kind)


def test_an_avi_file_without_a_part_is_not_whole(tmp_path):
    (tmp_path / "video").write_bytes(bytes(100))
    assert is_cut_off(tmp_path / "video", "avi")
