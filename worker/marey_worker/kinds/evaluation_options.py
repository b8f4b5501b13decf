"""The parameters of an evaluation as the options of `marey_motion.evaluation`."""

from __future__ import annotations

from marey_motion.evaluation.options import EvaluationOptions, Grid
from marey_motion.matching.options import ControllerOptions, DatabaseOptions, FeatureWeights
from marey_schemas.job_params import EvaluateParams

OF_THE_SUITE = (
    "families",
    "approach_s",
    "duration_s",
    "switch_speed_m_s",
    "switch_every_s",
    "window",
    "coverage_least_s",
    "literal_formulas",
)


def options_of(params: EvaluateParams) -> EvaluationOptions:
    """What decides the result beside the clips."""
    database = params.database
    return EvaluationOptions(
        grid=Grid(params.speeds_m_s, params.turn_rates_deg_s),
        database=DatabaseOptions(
            mirroring=database.mirroring,
            end_policy=database.end_policy,
            root_mode=database.root_mode,
            weights=FeatureWeights(**database.weights.model_dump()),
            horizons_s=database.horizons_s,
            extra_joints=database.extra_joints,
            keep_rest_poses=database.keep_rest_poses,
        ),
        controller=ControllerOptions(**params.controller.model_dump()),
        **{name: getattr(params, name) for name in OF_THE_SUITE},
    )
