"""Tasks drafted from an instruction are tasks that the instruction matches."""

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.success.task import load_task, match_task
from mtv_world_ros.success.task_draft import draft_task


@pytest.mark.parametrize(
    ('instruction', 'objects', 'relations'),
    [
        ('Put the red cube on the plate.', ['red cube', 'plate'], [('rests_on', 'a', 'b')]),
        ('stack the cup into the red cup', ['cup', 'red cup'], [('rests_on', 'a', 'b')]),
        (
            'place the fork and the knife to the left of the plate',
            ['fork', 'knife', 'plate'],
            [('left_of', 'a', 'c'), ('left_of', 'b', 'c')],
        ),
        ('move the red cube', ['red cube'], [('moved', 'a', None)]),
        ('shake the bottle', ['bottle'], [('shaken', 'a', None)]),
    ],
)
def test_the_instruction_matches_the_draft_and_names_its_objects(
    instruction, objects, relations, tmp_path
):
    file = tmp_path / 'task.yaml'
    file.write_text(draft_task(instruction, objects).text)
    task = load_task(file)
    found = [(r.kind, r.subject, getattr(r, 'target', None)) for r in task.relations]
    assert found == relations
    matched = match_task([task], instruction)
    assert matched is not None and list(matched[1].values()) == objects


def test_what_cannot_be_guessed_is_asked_for():
    with pytest.raises(ConfigError, match='give --relation, one of apart'):
        draft_task('admire the vase', ['vase'])
    assert draft_task('admire the vase', ['vase'], 'moved').task.relations[0].kind == 'moved'
    with pytest.raises(ConfigError, match='needs a second object'):
        draft_task('put the vase on something', ['vase'])
    with pytest.raises(ConfigError, match="does not hold 'mug'"):
        draft_task('put the cup on the plate', ['mug', 'plate'])
    with pytest.raises(ConfigError, match='which is not known'):
        draft_task('move the cup', ['cup'], 'moves')


def test_the_command_writes_the_file_and_keeps_another(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ['task', 'put the cup on the plate', '--objects', 'cup,plate']
    assert main(command) == 0
    assert 'use it with: --task put_the_a_on_the_b.yaml' in capsys.readouterr().out
    assert main(command) == 1
    assert main([*command, '--overwrite']) == 0
