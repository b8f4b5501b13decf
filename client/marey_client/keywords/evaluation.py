"""Keyword arguments of methods of the SDK: parameters of evaluations and of jobs that improve clips.

Written by `make docs` from the declarations of the options; change them there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, TypedDict

from marey_schemas.options.improvement import ObjectiveOptions
from marey_schemas.options.matching import ControllerOptions, DatabaseOptions, FeatureWeights
from marey_schemas.options.verdict import VerdictLimits


class FeatureWeightsKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `FeatureWeights`."""

    left_foot_position: float
    """Weight of the position of the left foot in the cost of a match; 0 leaves it out."""
    right_foot_position: float
    """Weight of the position of the right foot in the cost of a match; 0 leaves it out."""
    left_foot_velocity: float
    """Weight of the velocity of the left foot in the cost of a match; 0 leaves it out."""
    right_foot_velocity: float
    """Weight of the velocity of the right foot in the cost of a match; 0 leaves it out."""
    hip_velocity: float
    """Weight of the velocity of the hips in the cost of a match; 0 leaves it out."""
    trajectory_positions: float
    """Weight of the positions of the trajectory ahead in the cost of a match; 0 leaves it out."""
    trajectory_directions: float
    """Weight of the directions of the trajectory ahead in the cost of a match; 0 leaves it out."""
    extra_joints: float
    """Weight in the cost of a match of the position, and of the velocity, of each joint in the option `extra_joints` of
    the database; 0 leaves these joints out."""


class DatabaseKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `DatabaseOptions`."""

    mirroring: Literal["none", "add", "only"]
    """Mirrored copies of the clips. none: the clips alone; add: every clip and its mirrored copy; only: the mirrored
    copies alone."""
    end_policy: Literal["clamp", "trim", "loop"]
    """Handling of the end of a clip, where its future trajectory is unknown. clamp: the last frame is repeated, and the
    last 1/3 s is not selected; trim: frames after which the clip ends before the last of `horizons_s` are not selected;
    loop: in clips that are marked as loops, the beginning follows the end; other clips are treated as by clamp."""
    root_mode: Literal["simulated", "bone"]
    """Source of the character's motion on the ground. simulated: the smoothed position and heading of the body; bone:
    the root joint, for data whose root joint moves as the character does."""
    weights: FeatureWeights | FeatureWeightsKeywords
    """Weight of each group of features."""
    horizons_s: Sequence[float]
    """Times after the current frame at which trajectories are compared, in seconds, increasing."""
    extra_joints: list[str] | tuple[str, ...]
    """Standard joints to match in addition to feet and hips; with many joints the trajectory has too little weight."""
    rate_hz: float
    """Rate of the features and of the simulation, in hertz."""
    keep_rest_poses: bool
    """Keep frames at the beginning and end of a clip that look like a calibration or a T-pose."""


class ControllerKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `ControllerOptions`."""

    follow: Literal["time", "path", "open_loop"]
    """Points that each search asks for at the times `horizons_s` ahead, from the reference (the trajectory to follow).
    time: where the reference is at these times; path: points of the reference, measured from the point nearest to the
    character; open_loop: points that the character reaches from its present position with the speed and turn rate of
    the reference."""
    search_every_s: float
    """Seconds from one search of the clips for the best frame to the next search."""
    continuing_bias: float
    """Value added to the cost of continuing the current clip; negative values favour continuing."""
    switch_margin: float
    """Least reduction of the cost for which the character switches to another clip or frame."""
    reselect_window_s: float
    """Seconds around the current frame that a search does not select, so that the character does not tread on the spot;
    0 allows all frames."""
    half_life_s: float
    """Half-life, in seconds, with which the difference between the old and the new motion decays after a switch."""
    root_inertialisation: bool
    """Whether the blend after a switch also includes the root's velocity."""
    selection: Literal["features", "pose_distance"]
    """Cost that each search minimises. features: the squared distance of the weighted features; pose_distance: the same
    for the features of the trajectory only, plus the distances, in metres, between the joints of the current pose and
    those of the pose to which the character would switch, as in Abichequer Sangalli et al. (2022)."""
    root_adjustment: float
    """Rate, per second, at which the character is pulled to the trajectory that it follows: within a second, the
    distance shrinks by the factor exp(-rate). This hides tracking errors. 0: it is not pulled."""
    root_clamp_m: float | None
    """Greatest distance of the character from the trajectory that it follows, in metres; this hides tracking errors.
    Absent: no limit."""


class VerdictLimitsKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `VerdictLimits`."""

    lag_s: float
    """Greatest mean distance from the desired position, given as the time in seconds to cover the distance at the mean
    speed of the trial."""
    speed_share: float
    """Greatest error of the mean speed, as a share of the desired speed. In a switching trial, each speed is measured
    separately, away from the switches."""
    turn_deg_s: float
    """Greatest error of the mean turn rate, in degrees per second."""
    heading_deg: float
    """Greatest root mean square error of the heading, in degrees; the baseline of generated clips reaches 12."""
    speed_wobble_share: float
    """Greatest standard deviation of the speed, as a share of the desired speed. In a switching trial, it is measured
    away from the switches, as a share of the faster speed, because the character catches up after a switch. The
    baseline of generated clips reaches 0.19."""
    turn_wobble_deg_s: float
    """Greatest standard deviation of the turn rate, in degrees per second. The heading sways with each step: the
    baseline of generated clips reaches 21."""
    response_s: float
    """Greatest median time in which the character responds to a switch of the speed, in seconds. A switch without a
    response counts as slower than every response."""
    skate_m_s: float
    """Greatest mean speed of feet in contact, in metres per second, unless `skate_ratio` allows more. The default is
    the greatest speed of a foot that counts as standing."""
    skate_ratio: float
    """Greatest ratio of the mean speed of feet in contact to the same speed in the clips that the trial shows."""
    sinking_m: float
    """Greatest depth of the feet below the floor of the clips that the trial shows, in metres; the deepest 5 % of the
    time are left out. The baseline of generated clips reaches 0.006."""
    step_ratio: float
    """Greatest ratio between the contacts per metre of the trial and of the clips that it shows, in either direction.
    The ratio of the baseline of generated clips is between 0.97 and 1.05."""
    steps_per_m: float
    """Least number of foot contacts per metre; a sprinter has 0.4, so fewer show that the character glides."""
    pose_cost_ratio: float
    """Greatest ratio of the mean pose cost (change of pose from frame to frame) to its mean in the clips that the trial
    shows. The baseline of generated clips reaches 1.5."""
    pose_cost_p95_ratio: float
    """Greatest ratio of the 95th percentile of the pose cost (change of pose from frame to frame) to its mean in the
    clips that the trial shows."""
    transitions_per_s: float
    """Greatest number of transitions per second; 95 % of the trials with the baseline of generated clips have fewer
    than 5."""
    treading_per_s: float
    """Greatest number of transitions per second to a frame of the same clip at most 1/3 s away; the baseline of
    generated clips has none."""


class EvaluateKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `EvaluateParams`."""

    tags: list[str] | tuple[str, ...]
    """Tags that the results get."""
    speeds_m_s: Sequence[float]
    """Speeds of the trials in metres per second; each is combined with each turn rate."""
    turn_rates_deg_s: Sequence[float]
    """Turn rates of the trials in degrees per second, positive to the left."""
    families: Sequence[Literal["circle", "switching", "stopping", "corners", "eights", "strafing", "takes"]]
    """Kinds of trials. circle: a circle at constant speed; switching: the speed changes on the circle; stopping: the
    character stops and starts again on the circle; corners: straight lines with corners of `corner_angles_deg` between
    them; eights: two circles that touch, with the turn rate and its opposite; strafing: a straight line in a direction
    of `strafe_angles_deg`, while the character keeps facing ahead; takes: the paths of clips of the set, each of which
    is left out of the set in its own trial."""
    most_takes: int
    """Greatest number of `takes` trials. Their clips are chosen evenly from those that last at least 4 s and move at
    least 2 m. Of a long clip, the character follows at most `duration_s` seconds."""
    corner_angles_deg: Sequence[float]
    """Angles of the corners of `corners` trials in degrees, positive to the left; each is combined with each speed."""
    strafe_angles_deg: Sequence[float]
    """Directions of `strafing` trials in degrees from the facing direction, positive to the left; 180: backwards. Each
    is combined with each speed."""
    approach_s: float
    """Duration of the approach in seconds: the straight path before the circle."""
    duration_s: float
    """Duration of the circle in seconds, after the approach."""
    switch_speed_m_s: float
    """Second speed of switching trials, in metres per second; the first is one of `speeds_m_s`."""
    switch_every_s: float
    """Seconds that each speed of a switching trial lasts; also the seconds from a start to the next stop, and from
    corner to corner."""
    replicates: int
    """Number of replicates of each trial. The first one is the trial itself; each further one has another phase of the
    stride at the start, and an approach that is up to one second longer. Results are means with 95 % intervals. 1: only
    the trial itself, as in Abichequer Sangalli et al. (2022), without intervals."""
    seed: int
    """Seed of the random differences between the replicates of a trial."""
    window: Literal["circle", "all"]
    """Part of a trial that is measured. circle: the course after the approach; all: also the approach (the straight
    path before it)."""
    coverage_least_s: float
    """Seconds of data that a cell of the coverage map (a speed and a turn rate) needs to count as covered."""
    literal_formulas: bool
    """Also compute errors by the formulas of Abichequer Sangalli et al. (2022) exactly as they are printed, only to
    compare results with those of this publication."""
    database: DatabaseOptions | DatabaseKeywords
    """Options of the database that is built from the clips."""
    controller: ControllerOptions | ControllerKeywords
    """Options of the motion matching controller."""
    limits: VerdictLimits | VerdictLimitsKeywords
    """Limits within which a trial counts as followed."""
    name: str
    """Name of the result."""
    loops: list[str] | tuple[str, ...]
    """Clips that are loops, in addition to those tagged `loop`."""
    trims: Mapping[str, tuple[int, int]]
    """Range of frames to use, as first frame and the frame after the last, by the id of the clip; other clips are used
    whole."""
    baseline: bool
    """For comparison, also run the trials with a baseline: generated clips that contain every speed and turn rate."""
    report: bool
    """Write the report and its figures."""
    trial_figures: list[str] | tuple[str, ...]
    """Names of trials that get figures of their own, such as `circle v=1.25 w=-50`."""


class CompareKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `CompareParams`."""

    title: str
    """Title of the report; default: the names of the two evaluations."""
    report: bool
    """Write the report, a self-contained HTML page."""


class ObjectiveKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `ObjectiveOptions`."""

    offset: float
    """Weight of the mean distance between the character and the path that it follows."""
    abs_se_v: float
    """Metres that a speed error of 1 m/s adds to the objective."""
    abs_se_omega_deg: float
    """Metres that a turn rate error of 1 degree/s adds to the objective."""
    pose_cost: float
    """Metres that a pose cost of 1 m adds to the objective."""
    seconds: float
    """Metres that each second of data adds to the objective. A clip is worth removing if it lowers the other terms by
    less than its duration adds."""


class SuggestKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `SuggestParams`."""

    objective: ObjectiveOptions | ObjectiveKeywords
    """Weights of the objective: the cost of a set of clips."""
    estimation_replicates: int
    """Number of replicates of each trial in which effects are estimated, in order to choose among them. These
    replicates are the first ones of the evaluation, and further ones if it has fewer. Confirmations use other
    replicates, which neither the estimate nor the evaluation uses."""
    confirmation_replicates: int
    """Number of further replicates in which the chosen effects are measured again; these measurements are reported,
    with intervals. At least 3, or 0: effects are not confirmed. 3 to 6 are too few to confirm a step of an optimisation
    that has the same effect in every replicate: for three candidates, the sign test needs 7. A step that changes no
    trial needs no confirmation."""
    confirmation_seed: int
    """Seed of the replicates for confirmation. With another seed, the same choices are confirmed in different
    replicates."""
    removals: int
    """Greatest number of removals to plan, in addition to the clips that no trial uses. Each step removes the clip
    whose removal harms least per second of data. Steps after the first compare only the clips whose removal harmed
    least in the steps before. 0: none."""
    simulated_additions: int
    """Number of suggested additions whose effect on the trials is simulated: the first ones that have the skeleton of
    the set. Each simulation takes as long as an evaluation with `confirmation_replicates`."""
    consider: int | None
    """Number of clips whose removal is tried, one clip at a time, beginning with the clips that the fewest trials use;
    null: all clips."""
    duplicate_cm: float
    """Greatest distance per frame between near-duplicates, in centimetres."""
    blendable_m: float | None
    """Greatest distance between poses that can be blended, summed over joints, in metres; absent: the median over the
    transitions of the trials."""
    blendable_distance: float | None
    """With a metric, instead of `blendable_m`: greatest perceptual distance between poses that can be blended; absent:
    the median over the transitions of the trials."""
    lost_pose: float
    """With a metric: metres that each second of lost poses adds to the harm of a removal. A pose is lost if it looks
    like no pose of the remaining clips."""
    report: bool
    """Write the report, a self-contained HTML page."""


class OptimiseKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `OptimiseParams`."""

    objective: ObjectiveOptions | ObjectiveKeywords
    """Weights of the objective: the cost of a set of clips."""
    estimation_replicates: int
    """Number of replicates of each trial in which effects are estimated, in order to choose among them. These
    replicates are the first ones of the evaluation, and further ones if it has fewer. Confirmations use other
    replicates, which neither the estimate nor the evaluation uses."""
    confirmation_replicates: int
    """Number of further replicates in which the chosen effects are measured again; these measurements are reported,
    with intervals. At least 3, or 0: effects are not confirmed. 3 to 6 are too few to confirm a step of an optimisation
    that has the same effect in every replicate: for three candidates, the sign test needs 7. A step that changes no
    trial needs no confirmation."""
    confirmation_seed: int
    """Seed of the replicates for confirmation. With another seed, the same choices are confirmed in different
    replicates."""
    least_gain: float
    """Least decrease of the objective that a step must achieve, in metres. The value 0 is enough to exclude effects of
    chance, because every step must also be confirmed."""
    max_steps: int
    """Greatest number of steps."""
    max_evaluations: int | None
    """Greatest number of sets of clips to try; absent: no limit."""
    max_data_s: float | None
    """Greatest duration of the set in seconds; no clip is added that would exceed this duration; absent: no limit."""
    consider: int | None
    """Number of removals, and number of additions, to try in each step; null: all."""


class SweepKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `SweepParams`."""

    objective: ObjectiveOptions | ObjectiveKeywords
    """Weights of the objective: the cost of a set of clips."""
    estimation_replicates: int
    """Number of replicates of each trial in which effects are estimated, in order to choose among them. These
    replicates are the first ones of the evaluation, and further ones if it has fewer. Confirmations use other
    replicates, which neither the estimate nor the evaluation uses."""
    confirmation_replicates: int
    """Number of further replicates in which the chosen effects are measured again; these measurements are reported,
    with intervals. At least 3, or 0: effects are not confirmed. 3 to 6 are too few to confirm a step of an optimisation
    that has the same effect in every replicate: for three candidates, the sign test needs 7. A step that changes no
    trial needs no confirmation."""
    confirmation_seed: int
    """Seed of the replicates for confirmation. With another seed, the same choices are confirmed in different
    replicates."""
    factors: Sequence[float]
    """Factors to try. Each setting multiplies the weight of one group of features by one factor and leaves all other
    weights unchanged."""
