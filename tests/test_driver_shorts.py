"""A follower's board with a broken row line and two shorted cells: nothing to be read, said in one remark."""

from __future__ import annotations

from pathlib import Path

import pytest

from ohmskin.circuits import Reason
from ohmskin.driver import Skin

SCENE = """
[skin.design]
array = { rows = 8, columns = 8, row_segment = 0.3, column_segment = 0.3, row_lead = 25.0, column_lead = 5.0 }
drive = { voltage = 3.3 }
readout = { circuit = "voltage-feedback", reference_resistance = 10000.0 }
adc = { bits = 16, range = [0.0, 3.3] }

[board]
frame_rate = 100.0
noise = 0.0005

[[event]]
at_s = 0.0
kind = "broken-row"
place = [3, 0]

[[event]]
at_s = 0.0
kind = "shorted-cell"
place = [6, 2]

[[event]]
at_s = 0.0
kind = "shorted-cell"
place = [6, 5]
"""


def test_shorts_that_disturb_all_cells_are_named_in_a_remark(tmp_path: Path) -> None:
    """And in no other warning: an estimate that runs away to a short is none of the user's business."""
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    address = f"ohmskin://{scene}?clock=fast&duration=1.5&seed=7"
    with Skin.open(address, delivery="lossless") as skin:
        with pytest.warns(RuntimeWarning, match="look for shorted cells") as said:
            frames = list(skin)
        remark = skin.stats().remark
    assert len(said) == 1
    assert remark is not None
    assert "shorted cells" in remark
    assert not any(frame.valid.any() for frame in frames)
    assert (frames[-1].reason[6, [2, 5]] == Reason.SATURATED).all()
