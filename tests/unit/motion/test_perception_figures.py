"""The example in the explanation of the perceptual metric runs, and its figures agree with their captions."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marey_motion import generate_gait, map_joints
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.perception.cycles import find_period
from marey_motion.perception.measuring import measure_motion
from marey_motion.perception.metric import published_metric
from marey_motion.perception.registration import registration_curve
from marey_reports.drawing.drawn import Sketch
from marey_reports.perception.motion_maps import NamedClip, draw_registration

PAGE = Path(__file__).parents[3] / "docs" / "explanation" / "perceptual-metric.md"


def test_the_example_of_the_explanation_draws_both_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    names: dict[str, Any] = {}
    exec(example, names)
    assert re.findall(r"^(\w+)/manhattan ", capsys.readouterr().out, re.MULTILINE) == ["published", "uniform"]
    assert {path.name for path in tmp_path.iterdir()} == {"figure-1.png", "figure-6.png"}
    components, registration = names["figures"]
    assert isinstance(components, Sketch)
    assert components.tables["components"]["component"] == ["angles", "positions", "velocities", "all together"]
    means = components.tables["components"]["mean_distance"]
    assert means[3] == pytest.approx(np.mean(means[:3]))
    titles = [panel.get_title(loc="left") for panel in components.figure.axes]
    assert titles[:4] == ["angles", "positions", "velocities", "all together"]
    curve = registration.tables["curve"]
    np.testing.assert_allclose(np.asarray(curve["second_s"])[[0, -1]], [0.0, (names["fast"].clip.frame_count - 1) / 60])
    lines = registration.figure.axes[1].get_lines()
    np.testing.assert_allclose(lines[-1].get_ydata(), curve["second_s"])
    period_s = names["period"].frames / 60
    assert registration.tables["lags"]["lag_s"][np.argmin(registration.tables["lags"]["distance"])] == pytest.approx(
        period_s, abs=0.05
    )
    assert f"{period_s:.2f} s" in registration.caption
    assert "the distance of the two clips is another quantity" in registration.caption


def test_a_clip_has_the_same_label_in_both_maps_of_a_figure() -> None:
    metric, clip = published_metric("manhattan"), generate_gait(1.1, 0.0, 3.0)
    body = MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))
    measured = measure_motion(Motion.of(clip), body, clip.frame_rate_hz)
    first, second = NamedClip("07_04-walk", measured), NamedClip("07_05-walk", measured)
    curve = registration_curve(measured, measured, metric)
    panels = draw_registration(first, second, metric, find_period(measured, metric), curve).figure.axes[:2]
    assert [panel.get_xlabel() for panel in panels] == ["04-walk (s)", "04-walk (s)"]
    assert [panel.get_ylabel() for panel in panels] == ["04-walk (s)", "05-walk (s)"]
