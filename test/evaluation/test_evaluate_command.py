import json

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.cli.evaluate import Entry, parse_entries
from mtv_world_ros.core.errors import ConfigError


def test_rows_are_called_as_the_user_says_or_like_the_folder(tmp_path, monkeypatch):
    folder = tmp_path / 'runs' / 'wide' / 'checkpoint'
    folder.mkdir(parents=True)
    (tmp_path / 'a=b').mkdir()
    monkeypatch.chdir(tmp_path)
    assert parse_entries(['bundled', f'MTV-World={folder}', str(folder), 'a=b']) == [
        Entry('bundled', 'bundled'),
        Entry(str(folder), 'MTV-World', True),
        Entry(str(folder), 'wide'),
        Entry('a=b', 'a=b'),
    ]


def test_rows_that_are_called_alike_are_an_error():
    with pytest.raises(ConfigError, match="two are called 'x'; name them: NAME=FOLDER"):
        parse_entries(['one/x', 'two/x'])
    with pytest.raises(ConfigError, match="one is called ''"):
        parse_entries(['=one'])


@pytest.mark.slow
def test_checkpoints_are_compared_in_one_set_of_tables(episodes, tmp_path, capsys):
    dataset = episodes[0].parent
    out = tmp_path / 'out'
    arguments = ['--steps', '1', '--episodes', '1', '--no-ceiling', '--actions', 'true']
    command = ['evaluate', 'a=bundled', 'b c=bundled', str(dataset), '--out', str(out), *arguments]
    assert main([*command, '--threads', '1']) == 0
    printed = capsys.readouterr().out
    assert '1 of 3 episodes, split all' in printed and '| b c ' not in printed
    assert len(printed.splitlines()) == 5  # the data, a line a checkpoint, tables, report
    assert (
        'b c: follows the commands: cannot tell (episodes: 1, give at least 3); ' in printed
        and '; J of ' in printed
        and 'first frame held: ' in printed
    )
    assert 'no intervals below 3 episodes' in printed
    pictures = json.loads((out / 'b_c' / 'metrics.json').read_text())['pictures']['overall']
    psnr, held = (pictures[name]['value'] for name in ('psnr', 'psnr_held'))
    assert 5 < held < 60 and 5 < psnr < 60
    assert f'PSNR {psnr:.1f} dB (first frame held: {held:.1f} dB)' in printed
    assert '| b c ' in (out / 'paper_tables.md').read_text()
    assert 'Cannot tell from 1 episode: give at least 3.' in (out / 'report.html').read_text()
    metrics = json.loads((out / 'metrics.json').read_text())
    assert metrics['num_episodes'] == {'a': 1, 'b c': 1}
    first, second = (
        json.loads((out / name / 'metrics.json').read_text()) for name in ('a', 'b_c')
    )
    assert first['views'] == second['views'] == metrics['methods']['a']['views']
    assert first['provenance']['dataset'].endswith('1 of 3 episodes, split all')
    assert (out / 'report.html').stat().st_size > 10_000


def test_without_named_objects_the_line_is_of_pictures(make_episode, tmp_path, capsys):
    make_episode(tmp_path / 'data' / 'one', objects=(), instruction='wave')
    options = ['--steps', '1', '--no-ceiling', '--actions', 'true', '--threads', '1']
    command = ['evaluate', 'bundled', str(tmp_path / 'data'), '--no-report', *options]
    assert main([*command, '--out', str(tmp_path / 'out')]) == 0
    line = next(x for x in capsys.readouterr().out.splitlines() if x.startswith('bundled: '))
    assert 'give at least 3); PSNR ' in line and '–' not in line and 'J of' not in line


@pytest.mark.slow
def test_an_episode_without_a_result_is_told_and_is_in_the_exit_status(
    make_episode, tmp_path, capsys
):
    dataset = tmp_path / 'data'
    good, garbage = (make_episode(dataset / name) for name in ('good', 'garbage'))
    next(garbage.glob('*.mcap')).write_bytes(b'no recording at all')
    options = ['--steps', '1', '--no-ceiling', '--actions', 'true', '--threads', '1']
    command = ['evaluate', 'a=bundled', 'b=bundled', str(dataset), '--no-report', *options]
    assert main([*command, '--out', str(tmp_path / 'out')]) == 1
    said = capsys.readouterr().err
    assert said.count(f'mtv-world: {garbage} was not scored: ') == 1  # not once a checkpoint
    assert f'{good} was not' not in said
    metrics = json.loads((tmp_path / 'out' / 'a' / 'metrics.json').read_text())
    assert f'{garbage} was not scored: {metrics["failed"][str(garbage)]}\n' in said


def test_mistakes_are_told_in_a_line(episodes, tmp_path, capsys):
    dataset, out = str(episodes[0].parent), str(tmp_path)
    for options, words in (
        (['--actions', 'shuffled'], "'true' must be among them"),
        (['--quality', 'psrn'], "quality 'psrn' is not one of psnr, ssim, lpips"),
        (['--split', 'test'], "split 'test' is not one of"),
        (['--fid-weights', '/none.pth'], "fid_weights '/none.pth' does not exist"),
        (['--workers', '0'], 'workers is 0'),
    ):
        assert main(['evaluate', 'bundled', dataset, '--out', out, *options]) == 1
        assert words in capsys.readouterr().err
