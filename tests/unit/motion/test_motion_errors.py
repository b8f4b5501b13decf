"""Errors of the motion library have a text, a place and a code, and can be sent between processes."""

import pickle

import pytest

from marey_motion import errors


def test_a_format_error_reads_as_file_line_and_joint() -> None:
    error = errors.FormatError("three numbers are needed", file="walk.bvh", line=12, joint="Hips")

    assert str(error) == "walk.bvh:12, joint Hips: three numbers are needed"
    assert error.where == "walk.bvh:12, joint Hips"
    assert str(errors.FormatError("no frames")) == "no frames"


@pytest.mark.parametrize(
    "error",
    [
        errors.MotionError("a", code="b", where="c"),
        errors.ClipError("a", where="poses"),
        errors.AmbiguousUnits("a", file="x.bvh", line=3, joint="Hips"),
    ],
)
def test_errors_keep_all_they_carry_when_pickled(error: errors.MotionError) -> None:
    copy = pickle.loads(pickle.dumps(error))

    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)


def test_every_kind_of_error_has_a_code_of_its_own() -> None:
    def tree(kind: type[errors.MotionError]) -> list[type[errors.MotionError]]:
        return [kind, *(below for child in kind.__subclasses__() for below in tree(child))]

    kinds = [kind for kind in tree(errors.MotionError) if kind.__module__ == errors.__name__]
    assert len({kind.default_code for kind in kinds}) == len(kinds)
