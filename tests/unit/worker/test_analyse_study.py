"""Jobs of the kind `analyse_study`: the answers that are analysed, and the first finding of the result."""

from __future__ import annotations

import numpy as np
import pytest

from marey_motion.perception.study_analysis import analyse_study
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.studies import StudyDocument, StudyMotion
from marey_schemas.studies.conducting import JudgedTrial, JudgingParticipant
from marey_worker.context import JobRefused
from marey_worker.kinds.analyse_study import _headline, _judgements

MOTIONS = tuple(StudyMotion(clip=RevisionRef(item=f"clip_{number}", revision=1)) for number in range(5))
STUDY = StudyDocument(title="walks", consent_text="Yes.", motions=MOTIONS, trials=2)


def person(name: str, *chosen: tuple[int, int] | None) -> JudgingParticipant:
    """Return a participant who was shown the motions 4, 2, 0 and 1 in every trial."""
    trials = tuple(
        JudgedTrial(
            index=0, number=number, shown=(4, 2, 0, 1), chosen=pair, latency_s=1.0, timeouts_before=0, seed=1,
            client_fps=60.0,
        )
        for number, pair in enumerate(chosen, 1)
    )  # fmt: skip
    return JudgingParticipant(participant=name, finished=False, trials=trials)


def test_answers_are_analysed_and_timeouts_and_silent_people_are_left_out() -> None:
    found = _judgements(STUDY, [person("p1", (0, 1), None), person("p2", None), person("p3", (2, 3))])
    assert found.motion_count == 5
    np.testing.assert_array_equal(found.participants, [0, 1])
    analysis = analyse_study(found, [], name="walks", draws=0, seed=1)
    assert (analysis.table.chosen[4, 2], analysis.table.chosen[0, 1], analysis.table.shown[4, 0]) == (1, 1, 2)
    assert _headline(analysis)["trials"] == 2
    assert _headline(analysis)["best_shaping"] is None


def test_a_study_that_nobody_has_answered_is_refused() -> None:
    with pytest.raises(JobRefused, match="nobody has answered a trial") as refused:
        _judgements(STUDY, [person("p1", None)])
    assert refused.value.code == "no-judgements"
