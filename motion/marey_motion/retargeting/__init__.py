"""Retargeting: transfer of the motion of one skeleton to another, with any rest poses, proportions and local axes."""

from marey_motion.retargeting.clips import RetargetedClip, retarget, retarget_with_checks
from marey_motion.retargeting.planning import JointPair, RetargetPlan, plan_retarget

__all__ = ["JointPair", "RetargetPlan", "RetargetedClip", "plan_retarget", "retarget", "retarget_with_checks"]
