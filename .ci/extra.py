"""What an extra is for, in an environment that holds it alone: ``python -W error .ci/extra.py EXTRA``."""

import sys
import tempfile
from pathlib import Path

import numpy as np

import zoomjax as zj


def interop(folder: Path) -> None:
    """Maps and YAML, written and read again."""
    lens = zj.scenes.nikkor_18_200((120, 80))
    zj.interop.write(lens, folder / "maps", format="stmap", focal=[24, 50])
    zj.interop.write(lens, folder / "camera.yaml", format="ros", focal=35, pixel_pitch=0.2)
    for path in (folder / "maps", folder / "camera.yaml"):
        assert zj.interop.read(path).report.worst < 1


def lensfun(folder: Path) -> None:
    """A lens of the library, by a part of its name, saved and corrected by."""
    lens = zj.interop.library_lens(
        zj.interop.find_lenses("nikkor 18-200")[0], image_size=(1200, 800), crop=1.523
    )
    lens.save(folder / "lens.json")
    assert np.isfinite(zj.load_lens(folder / "lens.json")(35.0).undistort([0.0, 0.0])).all()


def heic(folder: Path) -> None:
    """A photo as phones take them, read."""
    import pillow_heif
    from PIL import Image

    pillow_heif.register_heif_opener()
    Image.fromarray(np.full((64, 96, 3), 90, np.uint8)).save(folder / "photo.heic")
    assert zj.io.read_photo(folder / "photo.heic")[0].shape == (64, 96, 3)


def raw(folder: Path) -> None:
    """A file that is called RAW and is none: refused by its name, by the library that would read it."""
    (folder / "photo.nef").write_bytes(b"II*\0" + bytes(1000))
    told = "nothing"
    try:
        zj.io.read_photo(folder / "photo.nef")
    except ValueError as error:
        told = str(error)
    assert "photo.nef" in told, f"of a file of zeros it said {told}"
    assert "zoomjax[raw]" not in told, "the extra is not seen"


def cluster(folder: Path) -> None:
    """Lines of a photo, found by a worker of Dask."""
    from distributed import Client

    photo = np.full((120, 160), 40, np.uint8)
    photo[60:] = 200
    source = zj.detect.Source("step", image=photo)
    with Client(n_workers=1, threads_per_worker=1, dashboard_address=None) as client:
        executor = client.get_executor(pure=False)
        [found] = zj.detect.detect([source], zj.detect.EdgeDetector(), executor=executor)
    assert not found.problem, found.problem
    assert len(found.lines) == 1


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        {extra.__name__: extra for extra in (interop, lensfun, heic, raw, cluster)}[sys.argv[1]](Path(name))
