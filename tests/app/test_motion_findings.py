"""What is said of a clip whose shots have different lenses."""

import numpy as np
import pytest

from zoomjax.app.motion_findings import with_contradictions
from zoomjax.fit._motion_apart import Apart
from zoomjax.fit.contradiction import CONTRADICTED, OTHER_LENS, warn_of_other_lens
from zoomjax.trust.assessment import Finding


def warning(shot, *, longer=0.05, corner=-3.21):
    """What `fit_motion` says."""
    with pytest.warns(UserWarning, match=OTHER_LENS) as told:
        warn_of_other_lens(Apart(1, longer, corner), np.array(shot))
    return str(told[0].message)


def test_a_shot_is_named_by_its_frames_and_what_it_differs_by():
    told = warning([-1] * 24 + [1] * 24)
    assert "the shot of frames 24 to 47 has focal lengths 5.1% longer, and a correction that" in told
    assert "moves the corners 3.21 px farther inwards, than by the lens of all shots." in told
    assert "frames 0 to 9 has focal lengths 4.9% shorter" in warning([0] * 10 + [1] * 5, longer=-0.05)
    assert "focal lengths 5.1% longer than by the lens of all shots." in warning([0, 1], corner=np.nan)
    assert "frames 5 to 7" in warning([0, 0, -1, -1, -1, 2, 2, 2, -1])  # the longer one of two


def test_the_finding_says_how_to_cut_the_shot_out():
    remark = Finding("cuts", "good", "the clip has 1 cut.", "Check.")
    first, second = (warning([-1] * number + [1] * 24) for number in (24, 20))
    found = with_contradictions([remark], [first, second])
    assert [of.verdict for of in found] == ["doubtful", "good"]  # once, though the clip is fitted twice
    assert found[0].found.startswith("shots contradict one lens: by itself the shot of frames 24 to 47")
    assert found[0].found.endswith("than by the lens of all shots.")
    assert "-vf trim=start_frame=24:end_frame=48,setpts=PTS-STARTPTS" in found[0].advice
    scale = f"{CONTRADICTED}: points are followed. Check whether they are in px."
    both = with_contradictions([remark], [scale, first])
    assert {of.about for of in both} == {"known focal lengths", "different lenses", "cuts"}
