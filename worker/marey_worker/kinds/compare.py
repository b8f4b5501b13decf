"""Kind `compare`: compares two evaluations of the same trials, and writes a document and a report."""

from __future__ import annotations

from typing import Any

from marey_motion.errors import MotionError
from marey_motion.evaluation.compare import Comparison, compare_results
from marey_motion.evaluation.improvement.suggestion_documents import comparison_to_tree
from marey_reports.evaluation.page import render_comparison
from marey_schemas.queue.job_params import CompareParams
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.evaluated_set import read_result, store_document, store_file

STEPS = 3


def run(context: Context, params: CompareParams) -> dict[str, Any]:
    """Compare two evaluations; the result counts the changes, and refers to the document and the report.

    Raises `JobRefused` if the evaluations have different normalisers, options or scenarios.
    """
    (first,), (second,) = context.inputs["before"], context.inputs["after"]
    context.progress(0, STEPS, "reading the evaluations")
    before, _ = read_result(context, first)
    after, _ = read_result(context, second)
    context.progress(1, STEPS, "comparing trials")
    try:
        comparison = compare_results(before, after)
    except MotionError as error:
        again = (
            f"`marey evaluate … --normaliser PROJECT/{first.path}` with the options of that evaluation makes an "
            "evaluation that can be compared"
        )
        raise JobRefused(error.code, f"{error}; {again}") from error
    document = {**comparison_to_tree(comparison), "names": {"before": first.path, "after": second.path}}
    result = {**_counts(comparison), "document": store_document(context, document)}
    if params.report:
        context.progress(2, STEPS, "writing the report")
        labels = (first.name, second.name) if first.name != second.name else ("before", "after")
        title = params.title or f"{first.path} and {second.path}"
        page = render_comparison(before, after, title=title, comparison=comparison, labels=labels)
        result["report"] = store_file(context, page.encode())
    return result


def _counts(comparison: Comparison) -> dict[str, Any]:
    verdicts = {change.metric: change.verdict for change in comparison.metrics}
    return {
        "trials": len(comparison.before.trials),
        "changed_trials": len(comparison.changed),
        "better": sorted(metric for metric, verdict in verdicts.items() if verdict == "better"),
        "worse": sorted(metric for metric, verdict in verdicts.items() if verdict == "worse"),
        "newly_unused": len(comparison.newly_unused),
        "removed": len(comparison.removed),
        "added": len(comparison.added),
    }
