"""Parameters of evaluation jobs: the options of the computation, a few others, and options in old documents."""

from typing import Any

from marey_motion.evaluation.result_documents import options_from_tree
from marey_motion.evaluation.scenario import suite_trials
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.queue.job_params import EvaluateParams

OF_RELEASE_0_1: dict[str, Any] = {
    "grid": {"speeds_m_s": [0.5, 2.0], "turn_rates_deg_s": [-30.0]},
    "families": ["switching"],
    "approach_s": 1.0,
    "duration_s": 12.0,
    "switch_speed_m_s": 3.0,
    "switch_every_s": 2.0,
    "window": "all",
    "coverage_least_s": 2.5,
    "literal_formulas": True,
    "database": {
        "mirroring": "add",
        "end_policy": "loop",
        "root_mode": "bone",
        "weights": {
            "left_foot_position": 0.75,
            "right_foot_position": 0.75,
            "left_foot_velocity": 1.0,
            "right_foot_velocity": 1.0,
            "hip_velocity": 2.0,
            "trajectory_positions": 1.0,
            "trajectory_directions": 1.5,
            "extra_joints": 1.0,
        },
        "horizons_s": [0.25, 0.75],
        "extra_joints": ["head"],
        "rate_hz": 60.0,
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
"""Options as documents of release 0.1 hold them."""


def test_options_of_documents_of_release_0_1_are_those_of_the_same_parameters() -> None:
    flat: dict[str, Any] = {**OF_RELEASE_0_1, **OF_RELEASE_0_1["grid"]}
    plain = {name: value for name, value in flat.items() if name != "grid"}
    asked = EvaluateParams.model_validate({**plain, "replicates": 1})  # there were no replicates
    assert options_from_tree(OF_RELEASE_0_1) == EvaluationOptions.of(asked)


def test_parameters_of_the_job_are_no_options_of_the_mathematics() -> None:
    options = EvaluationOptions.of(EvaluateParams(name="walks", trims={"clip_1": (0, 5)}, report=False))
    assert options == EvaluationOptions()
    assert hash(options) == hash(EvaluationOptions())


def test_the_count_of_trials_that_tasks_are_made_for_is_that_of_the_suite() -> None:
    params = EvaluateParams(speeds_m_s=(1.0, 2.0), turn_rates_deg_s=(0.0, 50.0, 100.0))
    assert len(suite_trials(params)) == params.trial_count
