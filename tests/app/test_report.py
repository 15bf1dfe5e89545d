"""The report: complete, escaped, by itself, and in a browser without errors, on a phone too."""

import base64
import dataclasses
import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace
from urllib.parse import unquote

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax.app.report
from zoomjax import RESULTS
from zoomjax.app.calibrating import calibrate
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.page import Run
from zoomjax.app.report import report
from zoomjax.models import Model, PolynomialZoom
from zoomjax.trust.comparison import ComparedModel
from zoomjax.trust.selection import Selection

from .._browser import opened

VOID = {"meta", "img", "br", "hr", "link", "input"}
INLINE = {"a", "b", "i", "span", "strong", "sub", "sup"}


class Page(HTMLParser):
    """What is on a page; raises where an element is not closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.elements, self.words = [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        if tag not in INLINE:
            self.words.append(" ")

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self):
        return " ".join("".join(self.words).split())

    def all(self, tag, attribute):
        return [attributes[attribute] for name, attributes in self.elements if name == tag]


REJECTED = 7
GIVEN = {"model": WantedModel("polynomial"), "centre": None}


@pytest.fixture(scope="module")
def calibration(noisy):
    """Four frames of the board, and one of the lines rejected."""
    done = calibrate(noisy, **GIVEN)
    return dataclasses.replace(done, rejected=np.arange(len(done.rejected)) == REJECTED)


@pytest.fixture(scope="module")
def text(calibration):
    return report(calibration)


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


@pytest.mark.slow
def test_page_is_well_formed_and_by_itself(page, text):
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert {"verdict", "next", "zoom", "straightness", "coverage", "lens", "distortion", "frames"} <= set(
        ids
    )
    assert [kind.get("type") for tag, kind in page.elements if tag == "script"] == [
        "application/json",
        None,
    ]
    for source in page.all("img", "src"):
        assert source.startswith(("data:image/svg+xml;base64,", "data:image/png;base64,"))
        assert len(base64.b64decode(source.split(",")[1], validate=True)) > 1000
    assert len(page.all("img", "src")) == 7
    assert all(page.all("img", "alt"))
    assert page.all("a", "href") == ["lens.json", "summary.json", "lines.npz", "model.png"]
    outside = [attributes for tag, attributes in page.elements if tag in ("link", "iframe", "object")]
    assert not outside
    assert not re.search(r"url\(|@import|fetch\(|XMLHttp|https?://(?!www\.w3\.org/2000/svg)", text)
    assert len(text) < 2_000_000


def test_page_says_what_the_summary_says(page, calibration):
    summary = json.loads(json.dumps(calibration.summary()))
    for key in ("rms_none", "rms_frames", "rms_algebraic", "rms_zoom"):
        assert f"{summary[key]:.4f}" in page.text
    for row in summary["per_frame"]:
        assert f"{row['rms_zoom']:.3f}" in page.text
    assert "The lens is proved to be invertible" in page.text
    assert summary["next_photo"]["sentence"] in page.text
    assert f"zoomjax {summary['versions']['zoomjax']}" in page.text
    for row in summary["corner_displacement"]:
        assert f"{row['px']:+.2f}".replace("-", "−") in page.text


def test_worst_lines_are_those_of_the_lens(page, calibration):
    """The distance of a line's corrected points to it, over the stretch across it, from singular values."""
    lines, lens = calibration.lines, calibration.fit.lens
    rms = []
    for line, frame in enumerate(np.asarray(lines.frame)):
        seen = np.asarray(lines.points[line])[np.asarray(lines.mask[line])]
        correct = lens(float(lines.focal[frame])).undistort
        corrected = np.asarray(correct(seen))
        _, (_, spread), (_, normal) = np.linalg.svd(corrected - corrected.mean(axis=0), full_matrices=False)
        across = [
            (np.asarray(correct(seen + d)) - np.asarray(correct(seen - d))) @ normal for d in np.eye(2)
        ]
        rms.append(spread / (np.linalg.norm(across) / 2))
    np.testing.assert_allclose(calibration.line_rms, rms, rtol=1e-6)
    assert re.search(rf"{REJECTED} at \(\d+, \d+\): {rms[REJECTED]:.2f} px, rejected", page.text)
    own = np.flatnonzero((np.asarray(lines.frame) == 0) & ~calibration.rejected)
    worst = own[np.argmax(np.array(rms)[own])]
    assert re.search(rf"{worst} at \(\d+, \d+\): {rms[worst]:.2f} px", page.text)


@pytest.fixture
def undrawn(monkeypatch):
    nothing = dict.fromkeys(("source", "label", "class", "width", "height"), "")
    monkeypatch.setattr(zoomjax.app.report, "embedded_plot", lambda *_, **__: nothing)


@pytest.mark.usefixtures("undrawn")
def test_names_are_escaped_and_lead_to_their_pictures(calibration):
    names = ['<script>alert("1")</script>.jpg', "a b/ü & #1?.png", "c", "d"]
    images = SimpleNamespace(
        used=[SimpleNamespace(name=name) for name in names],
        overlays=lambda: [f"{name}.jpg" for name in names],
        warnings=lambda: ["<b>two</b>\n  lines & more"],
        focals=SimpleNamespace(origin='"here" <there>'),
        prior=lambda: "The prior is that of an <i>18-200</i>.",
        shared=lambda: ["<i>3</i> photos share f"],
        verdicts=lambda: [("good", ""), ("doubtful", "<i>bent</i> otherwise"), ("good", ""), ("good", "")],
        bundle=None,
        board=lambda: ["The <i>board</i> counts as flat"],
    )
    page = Page(report(calibration, images))
    assert "doubtful<i>bent</i> otherwise" in page.text
    assert sum(tag == "script" for tag, _ in page.elements) == 2  # its own
    for name in names:
        assert name in page.text
    links = page.all("a", "href")[: len(names)]
    assert [unquote(link) for link in links] == [f"lines/{name}.jpg" for name in names]
    assert all(re.fullmatch(r"[\w/.%-]+", link) for link in links)
    assert "Warning: <b>two</b> lines & more" in page.text
    assert "The prior is that of an <i>18-200</i>." in page.text
    assert 'Focal lengths "here" <there>.' in page.text
    assert "The <i>board</i> counts as flat" in page.text


def test_what_is_not_determined_is_said(calibration):
    zoom = eqx.tree_at(
        lambda fit: (fit.covariance, fit.result),
        calibration.fit,
        (jnp.full_like(calibration.fit.covariance, jnp.inf), RESULTS.undetermined),
    )
    page = Page(report(dataclasses.replace(calibration, fit=zoom)))
    assert "Warning: The points do not determine" in page.text
    assert "not determined" in page.text


@pytest.mark.usefixtures("undrawn")
def test_a_lens_that_folds_is_called_so(calibration):
    zoom = eqx.tree_at(
        lambda fit: (fit.certificate.certified, fit.certificate.slope),
        calibration.fit,
        (jnp.array(False), jnp.array(-0.2)),
    )
    page = Page(report(dataclasses.replace(calibration, fit=zoom)))
    assert "The lens is not invertible" in page.text
    assert "falls to -0.2, at f = " in page.text


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("best", [0, 1])
def test_the_choice_of_a_model_is_explained_under_its_table(calibration, best):
    names = [Model(PolynomialZoom(1), 2), Model(PolynomialZoom(2), 2)]
    compared = tuple(ComparedModel(of, 8.3, 1.5, 1.7, 0.2, 0.0, 0.2) for of in names)
    chosen = Selection(names[0], names[best], calibration.fit, compared, "focal", 4, "least")
    page = Page(report(dataclasses.replace(calibration, selection=chosen)))
    why = (
        "worse than the best by no more than 0.05 %, which is nothing, that of fewest parameters is chosen"
    )
    assert (why in page.text) == bool(best)
    if best:
        assert page.text.index("degree 1, 2 terms") < page.text.index(why)


@pytest.mark.usefixtures("undrawn")
def test_long_lists_are_cut_to_the_worst_frames(calibration, monkeypatch):
    monkeypatch.setattr(zoomjax.app.report, "_MOST_FRAMES", 2)
    page = Page(report(calibration))
    assert "Of 4 frames, the 2 that the zoom model fits worst are shown." in page.text
    rms = np.asarray(calibration.fit.frame_rms)
    frames = page.text[page.text.index("worst lines are listed") :]
    for frame in range(4):
        assert (f"{rms[frame]:.3f}" in frames) == (frame in np.argsort(-rms)[:2])


def test_the_verdict_leads(page, calibration):
    found = calibration.assessment
    assert page.text.index(found.sentence) < page.text.index("Straightness")
    assert "before → after correction, in photos left out of the fit" in page.text


@pytest.mark.slow
def test_frames_are_sorted_by_focal_length(noisy):
    mixed = eqx.tree_at(lambda lines: lines.focal, noisy, noisy.focal[::-1])
    page = Page(report(calibrate(mixed, **GIVEN)))
    rows = page.text[page.text.index("worst lines 3 ") :]
    assert [rows.index(f" {frame} {float(f):.4g} ") for frame, f in enumerate(mixed.focal)][::-1] == sorted(
        rows.index(f" {frame} {float(f):.4g} ") for frame, f in enumerate(mixed.focal)
    )


def test_the_slider_shows_the_lens(text, calibration):
    data = json.loads(re.search(r'id="lens-data">(.*?)</script>', text)[1])
    lens = calibration.fit.lens
    for step in (0, 20, 40):
        corner = np.asarray(lens(data["focal"][step]).undistort(np.zeros(2)))
        moved = np.hypot(*(corner - lens.centre)) - np.hypot(*np.asarray(lens.centre))
        assert data["moved"][step][-1] == pytest.approx(moved, abs=0.02)
        line = np.array(data["grid"][step][0]), np.array(data["straight"][0])
        bent = np.asarray(lens(data["focal"][step]).distort(line[1].astype(float))) - line[1]
        np.testing.assert_allclose(line[0] - line[1], data["times"] * bent, atol=0.6 * data["times"] + 1)


def test_what_was_run_is_said(calibration):
    run = Run("A <b>lens</b>", (("Command", "zoomjax calibrate 'a b' -o out"),))
    page = Page(report(calibration, run=run))
    assert page.text.startswith("A <b>lens</b>:")
    assert "Command zoomjax calibrate 'a b' -o out" in page.text


@pytest.mark.slow
def test_enough_is_said_when_a_further_photo_shows_nothing(clean):
    exact = calibrate(clean, **GIVEN)
    assert exact.enough()
    told = "Enough: the standard deviation that noise gives the displacement, in the geometric mean"
    assert told in Page(report(exact)).text
    assert exact.summary()["next_photo"]["enough"] is True


PROBE = """<!DOCTYPE html><meta charset="utf-8"><title>probe</title>
<iframe id="page" src="report.html" style="width:{width}px;height:800px;border:0"></iframe>
<pre id="found"></pre>
<script>
onload = () => {{
  const page = document.getElementById("page").contentDocument;
  const images = [...page.images];
  document.getElementById("found").textContent = JSON.stringify({{
    width: page.documentElement.clientWidth,
    needed: page.documentElement.scrollWidth,
    images: images.length,
    shown: images.filter((image) => image.complete && image.naturalWidth > 0).length,
    moved: (() => {{
      const input = page.getElementById("zoom-at"), label = page.getElementById("zoom-label");
      const seen = [label.textContent, page.querySelector("#zoom-grid .bent").getAttribute("d")];
      input.focus();
      const focused = page.activeElement === input;
      input.value = 40;
      input.dispatchEvent(new Event("input"));
      return [focused, seen[0], label.textContent, input.getAttribute("aria-valuetext"),
        page.querySelector("#zoom-grid .bent").getAttribute("d") !== seen[1]];
    }})(),
    boxes: [...page.querySelectorAll(".box")].filter((box) => box.scrollWidth > box.clientWidth).length,
    marked: [...page.querySelectorAll(".box")].every(
      (box) => (box.scrollWidth > box.clientWidth + 1) === box.classList.contains("more-right")),
    fades: [...page.querySelectorAll(".more-right")].every(
      (box) => page.defaultView.getComputedStyle(box).maskImage.includes("gradient")),
  }});
}};
</script>"""


@pytest.mark.parametrize("width", [360, 1200])
def test_in_a_browser(text, tmp_path, width):
    """Nothing on the console, all images there, and only boxes scroll sideways."""
    (tmp_path / "report.html").write_text(text, encoding="utf-8")
    (tmp_path / "probe.html").write_text(PROBE.format(width=width), encoding="utf-8")
    document, console = opened(tmp_path / "probe.html", tmp_path / "profile")
    assert not console
    found = json.loads(re.search(r'<pre id="found">(.*?)</pre>', document)[1])
    assert found["width"] == width
    assert found["needed"] == width
    assert found["images"] == found["shown"] == 7
    focused, first, last, told, redrawn = found["moved"]
    assert focused
    assert redrawn
    assert first.startswith("f = 20.56 mm: the corner moves by")
    assert last.startswith("f = 127.4 mm: the corner moves by")
    assert told == last
    assert found["marked"]
    assert found["fades"]
    if width == 360:
        assert found["boxes"] > 0
