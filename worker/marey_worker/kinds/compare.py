"""Kind `compare`: compares evaluations of the same trials, and writes a document and a report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from marey_motion.errors import MotionError
from marey_motion.evaluation.compare import Comparison, compare_several, require_same_conditions
from marey_motion.evaluation.improvement.suggestion_documents import comparison_to_tree
from marey_motion.evaluation.result import EvaluationResult
from marey_reports.drawing.head import ReportInput
from marey_reports.evaluation.page import render_comparison
from marey_reports.evaluation.several import render_several
from marey_schemas.documents.evaluations import MOST_EVALUATIONS_COMPARED
from marey_schemas.queue.job_params import CompareParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.evaluated_set import read_result, store_document, store_file
from marey_worker.job_io.matching_clips import refusing_motion_errors
from marey_worker.job_io.stored_reports import inputs_of


def run(context: Context, params: CompareParams) -> dict[str, Any]:
    """Compare evaluations with the first of them; the result has counts, and refers to the document and the report.

    The document compares the first two evaluations; its member `others` contains a document for each further
    evaluation. Raises `JobRefused` if normalisers, options or scenarios differ, or if there are too many evaluations.
    """
    pins = (*context.inputs["before"], *context.inputs["after"], *context.inputs.get("others", ()))
    if len(pins) > MOST_EVALUATIONS_COMPARED:
        raise JobRefused(
            "too-many-evaluations",
            f"{len(pins)} evaluations cannot be compared at once; choose up to {MOST_EVALUATIONS_COMPARED}",
        )
    results = []
    for done, pin in enumerate(pins):
        context.progress(done, len(pins) + 2, f"reading {pin.path}")
        results.append(read_result(context, pin)[0])
    context.progress(len(pins), len(pins) + 2, "comparing trials")
    comparisons = _compared(pins, results)
    first, *others = (
        {**comparison_to_tree(one), "names": {"before": pins[0].path, "after": pin.path}}
        for one, pin in zip(comparisons, pins[1:], strict=True)
    )
    result = {**_counts(comparisons[0]), "document": store_document(context, {**first, "others": others})}
    if others:
        counts = zip(comparisons[1:], pins[2:], strict=True)
        result["others"] = [{"evaluation": pin.path, **_counts(one)} for one, pin in counts]
    if params.report:
        context.progress(len(pins) + 1, len(pins) + 2, "writing the report")
        page = _report(params, pins, results, comparisons, inputs_of(context))
        result["report"] = store_file(context, page.encode())
    return result


def _compared(pins: Sequence[PinnedInput], results: Sequence[EvaluationResult]) -> tuple[Comparison, ...]:
    """Compare each further evaluation with the first one.

    Raises `JobRefused` if two of them cannot be compared; the message contains a command that makes a comparable one.
    """
    for pin, other in zip(pins[1:], results[1:], strict=True):
        try:
            require_same_conditions(results[0], other)
        except MotionError as error:
            again = (
                f"`marey evaluate … --normaliser PROJECT/{pins[0].path}` with the options of that evaluation makes an "
                f"evaluation of the clips of {pin.path} that can be compared"
            )
            if "takes" in results[0].options.families:
                again = (
                    "trials along takes depend on the clips of each set, so evaluate both sets without the family "
                    f"`takes`, and with `--normaliser PROJECT/{pins[0].path}`"
                )
            raise JobRefused(error.code, f"{pins[0].path} and {pin.path}: {error}; {again}") from error
    with refusing_motion_errors():
        return compare_several(results[0], results[1:])


def _report(
    params: CompareParams,
    pins: Sequence[PinnedInput],
    results: Sequence[EvaluationResult],
    comparisons: Sequence[Comparison],
    inputs: Sequence[ReportInput],
) -> str:
    names = [pin.name for pin in pins]
    paths = [pin.path for pin in pins]
    title = params.title or f"{', '.join(paths[:-1])} and {paths[-1]}"
    if len(pins) > 2:
        labels = names if len(set(names)) == len(names) else paths
        return render_several(results, comparisons, title=title, labels=labels, inputs=inputs)
    pair = (names[0], names[1]) if names[0] != names[1] else ("before", "after")
    return render_comparison(results[0], results[1], title=title, comparison=comparisons[0], labels=pair, inputs=inputs)


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
