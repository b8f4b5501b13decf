"""Parameters of the job and options of the mathematics say the same."""

from dataclasses import asdict

from marey_motion.evaluation.options import EvaluationOptions
from marey_motion.evaluation.scenario import suite_trials
from marey_schemas.job_params import EvaluateParams
from marey_worker.kinds.evaluation_options import options_of


def test_the_defaults_of_both_are_the_same() -> None:
    assert asdict(options_of(EvaluateParams())) == asdict(EvaluationOptions())


def test_every_option_of_the_mathematics_can_be_asked_for() -> None:
    asked = EvaluateParams.model_validate(
        {
            "speeds_m_s": [0.5, 2],
            "turn_rates_deg_s": [-30],
            "families": ["switching"],
            "approach_s": 1,
            "duration_s": 12,
            "switch_speed_m_s": 3,
            "switch_every_s": 2,
            "window": "all",
            "coverage_least_s": 2.5,
            "literal_formulas": True,
            "database": {
                "mirroring": "add",
                "end_policy": "loop",
                "root_mode": "bone",
                "weights": {"hip_velocity": 2},
                "horizons_s": [0.25, 0.75],
                "extra_joints": ["head"],
                "keep_rest_poses": True,
            },
            "controller": {
                "follow": "path",
                "search_every_s": 0.2,
                "continuing_bias": -0.01,
                "switch_margin": 0.1,
                "reselect_window_s": 0.3,
                "half_life_s": 0.2,
                "root_inertialisation": False,
                "selection": "pose_distance",
                "root_adjustment": 0.5,
                "root_clamp_m": 0.4,
            },
        }
    )
    default, changed = asdict(EvaluationOptions()), asdict(options_of(asked))
    assert [name for name in default if default[name] == changed[name]] == []
    for group, fixed in (("database", ["rate_hz"]), ("controller", []), ("grid", [])):
        assert [name for name, value in default[group].items() if changed[group][name] == value] == fixed


def test_the_count_of_trials_that_tasks_are_made_for_is_that_of_the_suite() -> None:
    params = EvaluateParams(speeds_m_s=(1.0, 2.0), turn_rates_deg_s=(0.0, 50.0, 100.0))
    assert len(suite_trials(options_of(params))) == params.trial_count
