"""The searches of `benchmarks/reliability.py`, with small counts: none finds a silent wrong answer."""

import pytest

from benchmarks import reliability_core

COUNTS = {"compression": 96, "certificates": 300, "fits": len(reliability_core.SCENES)}


@pytest.mark.slow
@pytest.mark.parametrize(
    "search",
    [name if name == "compression" else pytest.param(name, marks=pytest.mark.slow) for name in COUNTS],
)
def test_a_search_finds_nothing_wrong(search, capsys):
    found = getattr(reliability_core, search)(COUNTS[search], seed=1)
    assert found["tried"] >= COUNTS[search]
    assert not any(found[what] for what in ("wrong", "lost", "crashed", "hung")), capsys.readouterr().out
