import pytest

from mtv_world_ros.cli import main


@pytest.mark.parametrize(
    ('options', 'says'),
    [
        (['--policies', 'exprt'], "did you mean 'expert'?"),
        (['--policies', 'expert-noise-9'], "'noise' is 9.0; it must be 0 to 0.5"),
        (['--tasks', 'stack_block_two'], "did you mean 'stack_blocks_two'?"),
        (['--episodes', '0'], '--episodes is 0; it must be at least 1'),
        (['--true-episodes', '-1'], '--true-episodes is -1; it must be 0 or more'),
        (['--max-chunks', '0'], '--max-chunks'),
        (['--physics', 'bald'], "unknown physics 'bald' (did you mean 'bold'?)"),
        (['--hold', '-1'], '--hold is -1; it must be 0 or more'),
        (['--describer', 'nowhere.yaml'], "describer file 'nowhere.yaml'"),
    ],
)
def test_a_wrong_option_is_refused_before_anything_runs(options, says, tmp_path, capsys):
    assert main(['rank', '--out', str(tmp_path / 'out'), '--episodes', '1', *options]) == 1
    assert says in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()
