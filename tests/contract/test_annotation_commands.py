"""Commands of annotations: documents may contain exactly the commands that can be applied."""

import inspect
from typing import get_args

from marey_motion.editing.annotations.commands import COMMANDS
from marey_schemas.editing.annotation_commands import AnnotationCommand


def test_each_command_that_travels_says_what_the_function_of_its_name_takes() -> None:
    models = get_args(get_args(AnnotationCommand)[0])
    travelling = {get_args(model.model_fields["command"].annotation)[0]: model for model in models}
    assert travelling.keys() == COMMANDS.keys()
    for name, model in travelling.items():
        _layer, *parameters = inspect.signature(COMMANDS[name]).parameters.values()
        assert set(model.model_fields) - {"command"} == {one.name for one in parameters}
        assert all(one.default is inspect.Parameter.empty for one in parameters)
