"""``zoomjax export``, ``import`` and ``formats``, as a user runs them."""

import json
import subprocess
import sys

import pytest

import zoomjax as zj
from zoomjax.app.results_folder import results_folder

from .._commands import SEVERAL
from ._lenses import LENSES, PITCH


def inputs_in(folder):
    """What no command may replace, not even with --overwrite."""
    return [folder / name for name in ("lens.json", "track.csv", "in/lens.json")]


def cut_map(folder):
    """Half of a map, of which OpenEXR itself complains in three lines."""
    zj.interop.write(LENSES["landscape"](), folder / "maps", format="stmap", focal=18)
    whole = (folder / "maps" / "undistort.18.exr").read_bytes()
    return whole[: len(whole) // 2]


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """What commands said, each with its status: run in one process, after each other."""
    folder = tmp_path_factory.mktemp("commands")
    LENSES["landscape"]().save(folder / "lens.json")
    (folder / "track.csv").write_text("frame,focal\n1,20\n3,40\n")
    (folder / "bad.json").write_text('{"fisheye_params": 1}')
    (folder / "photo.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    (folder / "photo.xml").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    (folder / "cut-undistort.exr").write_bytes(cut_map(folder))
    few = {"format": "gyroflow", "focal": [18, 40, 200], "pixel_pitch": PITCH}
    zj.interop.write(LENSES["landscape"](), folder / "few.json", **few)
    (folder / "in").mkdir()
    lens = LENSES["landscape"]()
    zj.interop.write(lens, folder / "in" / "lens.json", format="gyroflow", pixel_pitch=PITCH)
    with results_folder(folder / "mine", ["lens.json"]) as part:  # as calibrate does
        lens.save(part / "lens.json")
    before = {path: path.read_bytes() for path in inputs_in(folder)}
    lines = {
        "formats": "formats",
        "lensfun": "export lens.json --to lensfun --pixel-pitch 0.0367 -o a.xml",
        "again": "export lens.json --to lensfun --pixel-pitch 0.0367 -o a.xml",
        "overwrite": "export lens.json --to lensfun --pixel-pitch 0.0367 -o a.xml --overwrite",
        "track": "export lens.json --to pftrack --focal track.csv -o a.pfb",
        "no pitch": "export lens.json --to opencv --focal 24 -o a.yaml",
        "no focal": "export lens.json --to pftrack -o b.pfb",
        "no format": "export lens.json --to that -o b.pfb",
        "import": "import a.xml --image-size 640x480 -o back",
        "import again": "import a.xml --image-size 640x480 -o back",
        "import over": "import a.xml --image-size 640x480 -o mine",
        "import division": "import a.pfb --focal 20,30,40 --distortion-model division --terms 1 -o other",
        "in px": "import a.pfb --focal 500,700,1100 --focal-unit px -o pixels",
        "no numbers": "import a.pfb -o never",
        "smooth": "import few.json -o smooth",
        "table": "import few.json --table -o table",
        "terms": "import a.xml --image-size 640x480 --terms 9 -o never",
        "cut map": "import cut-undistort.exr -o never",
        "no size": "import a.xml -o never",
        "damaged": "import bad.json -o never",
        "foreign": "import photo.png -o never",
        "foreign by its name": "import photo.xml --from lensfun -o never",
        "no effect": "export lens.json --to opencv --focal 24 --pixel-pitch 0.0367 --tolerance 1 -o b.yaml",
        "no convention": "export lens.json --to nuke --focal 24 --convention nonsense -o b.nk",
        "no crop": "import a.pfb --focal 20,26,40 --crop 1.5 -o never",
        "a folder": "export lens.json --to stmap --focal 24 -o st.exr",
        "another size": "import in/lens.json --image-size 641x480 -o never",
        "its lens": "export lens.json --to gyroflow --pixel-pitch 0.0367 -o lens.json --overwrite",
        "its track": "export lens.json --to pftrack --focal track.csv -o track.csv --overwrite",
        "its folder": "export lens.json --to opencv --focal 24,35 --pixel-pitch 0.0367 -o . --overwrite",
        "its source": "import in/lens.json -o in --overwrite",
        "its source by a folder not there": "import in/lens.json -o in/new/.. --overwrite",
    }
    jobs = [[str(folder), ["zoomjax", *line.split()]] for line in lines.values()]
    done = subprocess.run(
        [sys.executable, "-c", SEVERAL], input=json.dumps(jobs), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert {path: path.read_bytes() for path in inputs_in(folder)} == before
    return folder, dict(zip(lines, json.loads(done.stdout), strict=True))


@pytest.mark.slow
def test_formats_are_listed(told):
    status, text = told[1]["formats"]
    assert status == 0
    head, *lines = text.splitlines()
    assert head.split() == ["format", "direction", "formula", "zoom", "tools"]
    assert [line.split()[0] for line in lines] == [fmt.name for fmt in zj.interop.formats()]
    [colmap] = [line for line in lines if line.startswith("colmap")]
    assert "refitted, exact for division" in colmap


def test_a_lens_goes_out_and_comes_back(told):
    folder, said = told
    status, text = said["lensfun"]
    assert status == 0, text
    assert "px between." in text
    assert said["overwrite"][0] == 0
    assert (folder / "a.pfb").read_text().startswith("#PFBarrel")
    assert said["import again"][0] == 0
    status, text = said["import"]
    assert status == 0, text
    assert zj.load_lens(folder / "back" / "lens.json").focal_unit == "mm"
    assert json.loads((folder / "back" / "import.json").read_text())["format"] == "lensfun"


def test_focal_lengths_that_a_file_does_not_say_may_be_in_px(told):
    folder, said = told
    assert said["in px"][0] == 0, said["in px"][1]
    lens = zj.load_lens(folder / "pixels" / "lens.json")
    assert lens.focal_unit == "px"
    assert list(lens.focal_range) == [500, 1100]


def test_the_model_of_an_import_can_be_chosen(told):
    folder, said = told
    assert said["import division"][0] == 0, said["import division"][1]
    lens = zj.load_lens(folder / "other" / "lens.json")
    assert isinstance(lens.distortion_model, zj.models.Division)
    assert lens(20.0).coefficients.shape == (1,)
    assert "interpolation: --table keeps to that." in said["smooth"][1]
    assert "--table" not in said["table"][1]
    told_of = [json.loads((folder / name / "import.json").read_text()) for name in ("smooth", "table")]
    assert told_of[1]["between"] < 0.1 < told_of[0]["between"]


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("again", "a.xml already exists and would be replaced: choose another place, or give --overwrite."),
        (
            "import over",
            "mine/lens.json already exists and would be replaced: choose another place, or give",
        ),
        ("no pitch", "Error: --pixel-pitch, mm from one pixel to the next"),
        ("no focal", "Error: --focal must be given, one focal length or several"),
        ("no format", "Error: --to must be one of stmap, nuke"),
        ("terms", "Error: --terms must be at most 4, but it is 9."),
        ("cut map", "from cut-undistort.exr: it is no EXR file, or it is damaged or cut off."),
        ("foreign", "Error: photo.png is of no format that is known: stmap, nuke"),
        ("foreign by its name", "Error: Cannot read a lensfun lens from photo.xml: "),
        ("no numbers", "give --focal, 3 of them, in mm, or in px with --focal-unit."),
        ("no size", "it holds no image size: give --image-size"),
        ("no effect", "Error: --tolerance has no effect on the format opencv: leave it out."),
        ("no convention", "Error: --convention has no effect on the format nuke: leave it out."),
        ("no crop", "Error: --crop has no effect on the format pftrack: leave it out."),
        ("a folder", "Error: The format stmap is several files here, and st.exr is to be their folder"),
        ("another size", "its images are 640x480 px: leave out --image-size, which is 641x480."),
        ("damaged", "Error: Cannot read a gyroflow lens from bad.json: "),
        ("its lens", "The output lens.json is the input"),
        ("its track", "The output track.csv is the input"),
        ("its folder", "lens.json is in the folder ., where files are replaced: choose another"),
        ("its source", "The output in/lens.json is the input"),
    ],
)
def test_an_error_is_one_sentence_with_the_names_of_options(told, name, sentence):
    folder, said = told
    status, text = said[name]
    assert status == 2
    assert sentence in text
    assert len(text.strip().splitlines()) == 1
    assert not any((folder / name).exists() for name in ("never", "st.exr", "b.yaml", "b.nk"))
