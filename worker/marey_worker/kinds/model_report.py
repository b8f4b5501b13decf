"""The report of a model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.modelling.search.check import SearchCheck, check_search
from marey_motion.modelling.training import TrainedPrimitive
from marey_motion.rigs import map_joints
from marey_reports.models.figures import ModelSubject, draw_alignment_figures, draw_model_figures
from marey_reports.models.page import render_model_report
from marey_schemas.documents.reports import ModelReport
from marey_schemas.job_params import ModelParams
from marey_worker.context import Context
from marey_worker.job_io.stored_reports import store_report


def write_model_report(
    context: Context, trained: TrainedPrimitive, aligned: AlignedSet, origin: Mapping[str, Any], params: ModelParams
) -> dict[str, Any]:
    """Draw every figure of a model and of its alignment, and write the page; the document that names them.

    Parameters
    ----------
    origin : where the examples come from, as the part `model` says it
    """
    title = trained.primitive.name
    check = _checked(context, trained, aligned) if params.search_check else None
    subject = ModelSubject(trained.primitive, aligned, trained.report, check, context.seed)
    figures = {**draw_alignment_figures(aligned), **draw_model_figures(subject)}
    page = render_model_report(trained, subject, figures, title=title, origin=origin)
    return store_report(context, ModelReport, title, page, ((None, figure) for figure in figures.values()))


def _checked(context: Context, trained: TrainedPrimitive, aligned: AlignedSet) -> SearchCheck | None:
    context.progress(0, None, "searching for what examples reached")
    skeleton = aligned.skeleton
    joints = {standard: skeleton.index_of(name) for standard, name in map_joints(skeleton).joints.items()}
    return check_search(aligned, joints, trained.options, seed=context.seed)
