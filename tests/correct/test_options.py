"""What each option of ``zoomjax undistort`` does: to photos of the lens's size and of others, and to video.

Every value of every option is tried on every kind of input: the result must be what `undistort_image` makes
with it, and another than without.
"""

import dataclasses

import av
import cv2
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.app.undistort_files import Job, undistort_files
from zoomjax.correct.video import undistort_video

SIZE = (96, 64)
KINDS = {
    "photo": [SIZE],
    "smaller": [(48, 32)],
    "larger": [(150, 100)],
    "mixed": [SIZE, (48, 32), (150, 100), (97, 65)],
    "video": [SIZE] * 3,
}

pytestmark = pytest.mark.filterwarnings("ignore:The lens is for images of")


def lens():
    """Barrel at 20 mm, pincushion at 80 mm, which leaves black corners."""
    zoom = zj.PolynomialZoom(1, jnp.array([[-0.17, 0.02], [0.43, -0.02]]), jnp.array(20.0))
    return zj.ZoomLens(zoom, jnp.array([47.5, 31.5]), jnp.array([20.0, 80.0]), SIZE)


def scene(size):
    """The same smooth picture in any size, nowhere dark."""
    x, y = np.meshgrid(*((np.arange(side) + 0.5) / side for side in size))
    return np.rint(160 + 40 * np.sin(23 * x + 5) * np.cos(17 * y) + 40 * np.sin(9 * x * y + 1)).astype(
        np.uint8
    )


def write_video(path):
    with av.open(str(path), "w") as out:
        stream = out.add_stream("ffv1", rate=25)
        stream.width, stream.height = SIZE
        stream.pix_fmt = "gray"
        for _ in KINDS["video"]:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(scene(SIZE), "gray")))
        out.mux(stream.encode(None))


def frames(path):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The inputs of each kind, with a lens and tables."""
    folder = tmp_path_factory.mktemp("options")
    lens().save(folder / "lens.json")
    sizes = sorted(set(KINDS["mixed"]))
    for size in sizes:
        cv2.imwrite(str(folder / f"{size[0]}.png"), scene(size))
    rows = [f"{size[0]}.png;{20 + 20 * i},0" for i, size in enumerate(sizes)]
    (folder / "image.csv").write_text("\n".join(["image;focal", *rows]))
    (folder / "track.csv").write_text("frame,focal\n0,20\n2,80\n")
    (folder / "short.csv").write_text("frame,focal\n0,20\n1,40\n")
    write_video(folder / "zoom.mkv")
    return folder


def run(made, kind, output, **options):
    """The corrected images of a kind, and what was said."""
    video = kind == "video"
    names = ["zoom.mkv"] if video else [f"{width}.png" for width, _ in KINDS[kind]]
    output.mkdir(exist_ok=True)
    target = output / "zoom.mkv" if video else output
    job = Job(
        made / "lens.json", tuple(made / name for name in names), target, **{"focal": "80", **options}
    )
    done = undistort_files(job)
    assert not done.skipped
    if video:
        return frames(target)
    return [cv2.imread(str(target / name), cv2.IMREAD_UNCHANGED) for name in names]


def expected(kind, focal, **options):
    """What `undistort_image` makes of them; one framing, "all" or "valid", for all focal lengths."""
    result = []
    for size, f in zip(KINDS[kind], focal, strict=True):
        scaled = zj.models.lens_for_size(lens(), size)
        keep = options.get("keep", "same")
        if keep != "same":
            spread = 1 / np.linspace(1 / min(focal), 1 / max(focal), 65 if len(set(focal)) > 1 else 1)
            keep = zj.correct.frame_output([scaled(float(each)) for each in spread], size, keep=keep)
        result.append(zj.undistort_image(scene(size), scaled(float(f)), **{**options, "keep": keep}))
    return result


OPTIONS = [
    {"keep": "all"},
    {"keep": "valid"},
    {"interpolation": "nearest"},
    {"interpolation": "cubic"},
    {"interpolation": "lanczos"},
    {"border": "replicate"},
    {"border": "reflect"},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_an_option_does_to_all_what_it_does_to_one_image(made, tmp_path, kind, options):
    focal = [80.0] * len(KINDS[kind])
    found = run(made, kind, tmp_path, **options)
    without = expected(kind, focal)
    for image, wanted, plain, size in zip(
        found, expected(kind, focal, **options), without, KINDS[kind], strict=True
    ):
        assert image.shape == size[::-1]
        np.testing.assert_allclose(image.astype(int), wanted, atol=1)
        assert (abs(image.astype(int) - plain) > 1).any()


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_kept_is_the_same_part_in_every_size(made, tmp_path, kind):
    """ "valid" shows no black, "all" and "same" do; and made equally large, all sizes show the same."""
    for keep, black in (("valid", 0), ("same", 0.01), ("all", 0.005)):
        found = run(made, kind, tmp_path / keep, keep=keep)
        for image in found:
            assert (image < 60).mean() > black if black else image.min() > 60
            assert (image < 60).mean() < 0.25
            alike = cv2.resize(image, (48, 32), interpolation=cv2.INTER_AREA).astype(int)
            assert np.median(abs(alike - cv2.resize(found[0], (48, 32), interpolation=cv2.INTER_AREA))) <= 4


@pytest.mark.slow
@pytest.mark.parametrize("keep", ["same", "all", "valid"])
def test_focal_lengths_of_a_table_share_one_framing(made, tmp_path, keep):
    for kind, table, focal in (
        ("mixed", "image.csv", [40, 20, 80, 60]),
        ("video", "track.csv", [20, 32, 80]),
    ):
        found = run(made, kind, tmp_path / kind, keep=keep, focal=str(made / table))
        wanted = expected(kind, focal, keep=keep)
        for image, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(image.astype(int), other, atol=1)


def test_hold_is_for_tracks(made, tmp_path):
    with pytest.raises(ValueError, match="goes from 0 to 1 frames, and frame 2"):
        run(made, "video", tmp_path, focal=str(made / "short.csv"))
    held = run(made, "video", tmp_path, focal=str(made / "short.csv"), hold=True)
    np.testing.assert_allclose(held[2].astype(int), expected("video", [20, 40, 40])[2], atol=1)
    for kind in ("photo", "video"):
        with pytest.raises(ValueError, match="Argument hold is for"):
            run(made, kind, tmp_path / "no", hold=True)


def test_the_output_is_a_file_or_a_folder(made, tmp_path):
    photo = (made / "96.png",)
    plain = Job(made / "lens.json", photo, tmp_path / "one.png", "80")
    undistort_files(plain)
    undistort_files(dataclasses.replace(plain, output=tmp_path / "new" / "folder"))
    one = (tmp_path / "one.png").read_bytes()
    assert (tmp_path / "new" / "folder" / "96.png").read_bytes() == one
    for output, reason in (("a.gif", "must end in one of"), ("a.mp4", "must end in one of")):
        with pytest.raises(ValueError, match=reason):
            undistort_files(dataclasses.replace(plain, output=tmp_path / output))
        assert not (tmp_path / output).exists()
    both = dataclasses.replace(plain, inputs=(made / "96.png", made / "48.png"), output=tmp_path / "b.png")
    with pytest.raises(ValueError, match="must be a folder"):
        undistort_files(both)


@pytest.mark.parametrize("focal", ["1_000", "20,5", "nan", "0x20", "٣٥", "-3", "0", "wide"])
@pytest.mark.parametrize("kind", ["photo", "video"])
def test_focal_lengths_are_plain_numbers(made, tmp_path, kind, focal):
    with pytest.raises(ValueError, match="Argument focal must be a positive number"):
        run(made, kind, tmp_path, focal=focal)
    assert not list(tmp_path.iterdir())


def test_a_framing_is_scaled_with_the_lens(made, tmp_path):
    """One made for the lens's size, for a photo and a video of another."""
    framing = zj.correct.frame_output(lens()(80.0), SIZE, keep="valid", size=(60, 40))
    with pytest.warns(UserWarning, match="its distortion is scaled"):
        zj.undistort_photo(made / "48.png", tmp_path / "a.png", lens=lens(), focal=80.0, keep=framing)
    zj.undistort_photo(made / "96.png", tmp_path / "b.png", lens=lens(), focal=80.0, keep=framing)
    small, large = (cv2.imread(str(tmp_path / name), cv2.IMREAD_UNCHANGED) for name in ("a.png", "b.png"))
    assert (small.shape, large.shape) == ((20, 30), (40, 60))
    assert (
        np.median(abs(cv2.resize(large, (30, 20), interpolation=cv2.INTER_AREA).astype(int) - small)) <= 4
    )
    double = zj.models.lens_for_size(lens(), (192, 128))
    undistort_video(
        made / "zoom.mkv",
        tmp_path / "c.mkv",
        lens=double,
        focal=80.0,
        keep=zj.correct.frame_output(double(80.0), (192, 128), keep="valid", size=(120, 80)),
    )
    np.testing.assert_allclose(frames(tmp_path / "c.mkv")[0].astype(int), large, atol=2)
