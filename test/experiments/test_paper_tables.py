"""The paper's tables by one command: rows, resuming, other data, and what cannot be done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import errno
import json
from pathlib import Path
import shutil
import sys
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import pytest
from safetensors.torch import save_file
import torch

from mtv_world_ros.cli import main as mtv_world
from mtv_world_ros.cli.train import set_overrides
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.evaluation.metrics.statistics import Estimate
from mtv_world_ros.training.trainer import learning_rate
from mtv_world_ros.training.training_config import load_training_config
from test.support.launched import ENVIRONMENT
from test.support.scripts import imported_scripts
from test.support.sources import set_options, TINY_MODEL
from test.support.wan_base import make_base, tiny_preset

TASK = 'stack_blocks_two'
#: what the tests of the whole run train
ROWS = 'mtv_world,single_view_low'


@pytest.fixture(scope='module')
def tables() -> Iterator[ModuleType]:
    """The experiment as a module."""
    with imported_scripts('paper_tables') as (script,):
        yield script


@pytest.fixture(scope='module')
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes of one task, two to train on and two to test."""
    folder = tmp_path_factory.mktemp('data')
    names = [f'{TASK}_{index:05d}' for index in range(4)]
    for name in names:
        shutil.copytree(share_path('resource', 'demo_episode'), folder / name)
    write_card(folder, dict.fromkeys(names, TASK))
    return folder


def write_card(folder: Path, tasks: dict[str, str]) -> None:
    """Write the card of a data set, as far as it is read here."""
    names = list(tasks)
    card = {
        'splits': {'train': names[::2], 'test': names[1::2]},
        'episodes': [{'name': name, 'task': task} for name, task in tasks.items()],
    }
    (folder / 'dataset.json').write_text(json.dumps(card))


def words_of(out: Path, data: Path, rows: str = ROWS, *more: str) -> list[str]:
    """A command line with a tiny budget."""
    return [
        '--out', str(out), '--data', str(data), '--tasks', TASK, '--clips', '1', '--rows', rows,
        '--zero-shot-episodes', '0', '--no-lite-features', *set_options(TINY_MODEL), *more,
    ]  # fmt: skip


class Recorder:
    """Runs commands, or fails instead, and remembers them."""

    def __init__(self, run: Callable[[list[str]], int] = mtv_world) -> None:
        self.commands: list[list[str]] = []
        self._run = run

    def __call__(self, words: list[str]) -> int:
        self.commands.append(words)
        return self._run(words)


@pytest.fixture(scope='module')
def finished(tables: ModuleType, data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of two rows."""
    out = tmp_path_factory.mktemp('tables') / 'out'
    assert tables.main(words_of(out, data), Recorder()) == 0
    return out


@pytest.fixture
def run_folder(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished run in another place."""
    return Path(shutil.copytree(finished, tmp_path / 'out', symlinks=True))


@pytest.mark.slow
def test_rows_are_trained_and_tested_and_their_cells_are_filled(finished: Path):
    text = (finished / 'tables.md').read_text()
    for heading in ('Table 1', 'react to their actions', 'Table 3: J x 100', 'Clips and time'):
        assert f'## {heading}' in text or heading in text
    assert 'no weights' in text  # of FID and FVD
    lines = [line for line in text.splitlines() if line.startswith('| MTV-World')]
    numbers = [cell for line in lines for cell in line.split('|')[2:-1] if '0.' in cell]
    assert len(numbers) >= 4
    averaged = [line.split('|') for line in text.splitlines() if '| Task Averaged' in line]
    head = next(line for line in text.splitlines() if line.startswith('| Task ')).split('|')
    single = [cell.strip() for cell in head].index('Single-View')
    low, high = averaged[0][single].strip(), averaged[1][single].strip()
    assert float(low.split()[0]) > 0 and high == '–'  # of the view that was trained
    trained = json.loads(
        (
            finished / 'rows/single_view_low/seed_0/clips_000001/checkpoint/world_model.json'
        ).read_text()
    )
    assert trained['views'] == ['low'] and trained['trained_on']['steps'] == 1
    assert trained['rendering']['link_width_m'] is None  # the paper draws trails alone


@pytest.mark.slow
def test_a_finished_run_runs_nothing_again(tables: ModuleType, run_folder: Path, data: Path):
    again = Recorder(lambda words: 1)
    assert tables.main(words_of(run_folder, data), again) == 0
    assert again.commands == []


@pytest.mark.slow
def test_a_row_is_added_later_without_touching_the_others(
    tables: ModuleType, run_folder: Path, data: Path
):
    later = Recorder()
    assert tables.main(words_of(run_folder, data, f'{ROWS},without_mask'), later) == 0
    assert [words[0] for words in later.commands] == ['train', 'evaluate', 'evaluate']
    modes = [words[words.index('--mode') + 1] for words in later.commands[1:]]
    assert modes == ['imagine', 'observe']
    assert all('without_mask' in ' '.join(words) for words in later.commands)
    curve = (run_folder / 'tables.md').read_text().partition('## Learning curve')[2]
    assert '| without_mask ' in curve


@pytest.mark.slow
def test_distances_asked_for_later_are_measured_alone(
    tables: ModuleType, run_folder: Path, data: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(tables, 'frame_features', lambda path: None)
    asked = Recorder(lambda words: 1)
    assert tables.main(words_of(run_folder, data, ROWS, '--fid-weights', 'fid.pth'), asked) == 1
    (words,) = asked.commands
    assert words[0] == 'evaluate' and words[words.index('--fid-weights') + 1] == 'fid.pth'
    assert '--overwrite' in words


@pytest.mark.slow
def test_rows_of_wan_are_adapters_that_two_processes_train(
    tables: ModuleType, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    preset = tiny_preset(tmp_path)
    base = make_base(tmp_path / 'wan', load_training_config(preset))
    out, latents = tmp_path / 'out', tmp_path / 'latents'
    launcher = f'{sys.executable} -m torch.distributed.run --standalone --nproc-per-node 2'
    words = [
        '--out', str(out), '--data', str(data), '--tasks', TASK, '--clips', '4', '--rows', ROWS,
        '--test-episodes', '1', '--zero-shot-episodes', '0', '--no-lite-features',
        '--preset', str(preset), '--init', str(base), '--latent-cache', str(latents),
        '--launcher', launcher,
    ]  # fmt: skip
    tested = Recorder()
    assert tables.main(words, tested) == 0
    for row in ROWS.split(','):
        adapter = out / 'rows' / row / 'seed_0' / 'clips_000004' / 'adapter'
        assert (adapter / 'pytorch_lora_weights.safetensors').is_file()
        trained = json.loads((adapter / 'world_model.json').read_text())['trained_on']
        assert trained['steps'] == 2  # of two clips
        assert any((latents / row).iterdir())
    # trainings are of the launcher, tests of this process, with the adapter
    assert {command[0] for command in tested.commands} == {'evaluate'}
    assert all('--adapter' in command for command in tested.commands)
    text = (out / 'tables.md').read_text()
    assert '## Table 1: methods by view, 4 clips a row' in text
    assert [line for line in text.splitlines() if line.startswith('| MTV-World') and '0.' in line]


def test_an_adapter_without_its_base_is_refused(
    tables: ModuleType, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    words = ['--out', str(tmp_path / 'out'), '--data', str(data), '--preset', 'wan-1.3b']
    assert tables.main(words) == 1
    assert "preset 'wan-1.3b' trains a LoRA adapter: give --init" in capsys.readouterr().err


def test_workers_and_frames_a_second_go_to_the_commands_that_take_them(
    tables: ModuleType, tmp_path: Path
):
    asked = Recorder(lambda words: 1)
    words = ['--out', str(tmp_path / 'out'), '--fps', '16', '--workers', '4', '--ray', 'head:1',
             '--gpus-per-worker', '0.5', '--no-lite-features']  # fmt: skip
    assert tables.main(words, asked) == 1
    (collect,) = asked.commands
    given = ' '.join(collect)
    assert collect[0] == 'collect' and given.endswith(
        '--workers 4 --ray head:1 --gpus-per-worker 0.5 --fps 16'
    )


def test_a_command_that_is_stopped_says_how_to_go_on(
    tables: ModuleType, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    stopped = Recorder(lambda words: 130)
    assert tables.main(words_of(tmp_path / 'out', data), stopped) == 130
    told = capsys.readouterr().err
    assert 'single_view_low, seed 0, 1 clips: training' in told and 'ended with status 130' in told
    assert 'run the same command again to go on' in told
    again = Recorder(lambda words: 130)
    tables.main(words_of(tmp_path / 'out', data), again)
    assert again.commands == stopped.commands  # it begins where it was stopped


def test_a_full_disk_is_told_and_nothing_half_written_stays(
    tables: ModuleType,
    data: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr(tables, 'write_json', full)
    assert tables.main(words_of(tmp_path / 'out', data), Recorder(lambda words: 0)) == 1
    told = capsys.readouterr().err
    assert 'No space left on device' in told and 'once there is room' in told
    assert not (tmp_path / 'out' / 'settings.json').exists()


def test_a_folder_with_other_tasks_is_refused_with_their_names(
    tables: ModuleType, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    other = Path(shutil.copytree(data, tmp_path / 'data'))
    names = sorted(path.name for path in other.iterdir() if path.is_dir())
    write_card(other, dict(zip(names, [TASK, TASK, TASK, 'fold_towel'], strict=True)))
    nothing = Recorder(lambda words: 1)
    assert tables.main(words_of(tmp_path / 'out', other), nothing) == 1
    assert 'not asked for are fold_towel' in capsys.readouterr().err
    assert nothing.commands == []
    fifteen = [w for w in words_of(tmp_path / 'all', data) if w not in ('--tasks', TASK)]
    assert tables.main(fifteen, nothing) == 1
    assert 'missing are bussing_table, collect_food' in capsys.readouterr().err


def test_a_folder_that_is_no_data_set_is_refused(
    tables: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture
):
    assert tables.main(words_of(tmp_path / 'out', tmp_path), Recorder(lambda words: 1)) == 1
    assert 'has no readable dataset.json' in capsys.readouterr().err


def test_a_run_of_other_settings_is_not_mixed_with_this_one(
    tables: ModuleType, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    nothing, out = Recorder(lambda words: 1), tmp_path / 'out'
    tables.main(words_of(out, data), nothing)
    capsys.readouterr()
    assert tables.main([*words_of(out, data), '--preset', 'small'], nothing) == 1
    assert "preset is 'paper' there, 'small' now" in capsys.readouterr().err
    assert tables.main([*words_of(out, data), '--test-episodes', '1'], nothing) == 1
    assert 'test_episodes is None there, 1 now' in capsys.readouterr().err


def test_a_row_that_another_process_works_on_is_left_to_it_and_looked_at_again(
    tables: ModuleType, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """While single_view_low is held, mtv_world is begun; then the other, once it is free."""
    begun, busy = [], tmp_path / 'out' / 'rows' / 'single_view_low' / 'seed_0'
    busy.mkdir(parents=True)
    held = tables.locked(busy)
    held.__enter__()
    monkeypatch.setattr(tables.time, 'sleep', lambda _: held.__exit__(None, None, None))
    monkeypatch.setattr(
        tables.PaperTables, '_do_stage', lambda run, row, seed, stage: begun.append(row.name)
    )
    assert tables.main(words_of(tmp_path / 'out', data), Recorder(lambda words: 1)) == 0
    assert begun == ['mtv_world', 'single_view_low']


def test_all_rows_have_a_stage_before_any_goes_on_to_the_next(
    tables: ModuleType, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    begun = []
    monkeypatch.setattr(
        tables.PaperTables,
        '_do_stage',
        lambda run, row, seed, stage: (
            (stage, row.name) in begun or begun.append((stage, row.name))
        ),
    )
    words = words_of(tmp_path / 'out', data, ROWS, '--clips', '2,4')
    assert tables.main(words, Recorder(lambda words: 1)) == 0
    rows = ['single_view_low', 'mtv_world']
    assert begun == [(stage, name) for stage in (2, 4) for name in rows]


@pytest.mark.parametrize('clips', ['4,2', '2,2', '0'])
def test_stages_that_do_not_rise_are_refused(
    tables: ModuleType, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture, clips: str
):
    words = words_of(tmp_path / 'out', data, ROWS, '--clips', clips)
    assert tables.main(words, Recorder(lambda words: 1)) == 1
    assert f'--clips is {clips}; give numbers that rise' in capsys.readouterr().err


def test_the_learning_rate_of_a_step_does_not_depend_on_later_stages(
    tables: ModuleType, data: Path, tmp_path: Path
):
    """Rates of the first stage's steps, from the words of the trainings of two stages."""
    options = tables.parser().parse_args(['--out', str(tmp_path), '--clips', '500,8000'])
    run = tables.PaperTables(options)
    rates = []
    for stage in (500, 8000):
        words = run._training(tables.ROWS[0], 0, stage)
        sets = [word.partition('=')[2] for word in words if word.startswith('--set=')]
        config = load_training_config('paper', set_overrides(sets)).optimizer
        rates.append([learning_rate(step, config) for step in range(250)])
    assert rates[0] == rates[1]
    assert rates[0][-1] == 6e-4  # of the preset: it does not decay


@pytest.mark.slow
def test_a_row_goes_on_to_a_further_stage_and_keeps_the_earlier_numbers(
    tables: ModuleType, run_folder: Path, data: Path
):
    """From 1 clip to 4, in steps of one: the curve has both, the tables the last of all rows."""
    before = (run_folder / 'rows/mtv_world/seed_0/clips_000001/test/metrics.json').read_bytes()
    further = Recorder()
    words = words_of(run_folder, data, ROWS, '--clips', '1,4', '--test-episodes', '2,1')
    # a stage that is there is tested as it was
    assert tables.main(words, further) == 1 and further.commands == []
    words = words_of(run_folder, data, ROWS, '--clips', '1,4')
    assert tables.main([*words, '--rows', 'mtv_world'], further) == 0
    assert [command[0] for command in further.commands] == ['train', 'evaluate', 'evaluate']
    row = run_folder / 'rows/mtv_world/seed_0'
    assert (row / 'clips_000001/test/metrics.json').read_bytes() == before
    steps = [tables.trained_steps(row / name / 'checkpoint') for name in
             ('clips_000001', 'clips_000004', 'training')]  # fmt: skip
    assert steps == [1, 4, 4]
    text = (run_folder / 'tables.md').read_text()
    assert '## Table 1: methods by view, 1 clips a row\n' in text  # the other row has no more
    curve = text.partition('## Learning curve')[2].partition('##')[0]
    points = [line.split('|')[1:3] for line in curve.splitlines() if '_' in line]
    assert [[cell.strip() for cell in point] for point in points] == [
        ['single_view_low', '1'], ['mtv_world', '1'], ['mtv_world', '4']
    ]  # fmt: skip


@pytest.mark.slow
def test_a_stage_below_what_a_row_was_trained_for_is_left_out(
    tables: ModuleType, run_folder: Path, data: Path, capsys: pytest.CaptureFixture
):
    words = words_of(run_folder, data, 'mtv_world', '--clips', '1,8')
    assert tables.main(words, Recorder()) == 0
    nothing = Recorder(lambda words: 1)
    words = words_of(run_folder, data, 'mtv_world', '--clips', '1,4,8')
    assert tables.main(words, nothing) == 0 and nothing.commands == []
    assert '4 clips: left out, the row was trained further' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('rows', 'message'),
    [
        ('mtv_wrld', r"no row \(did you mean 'mtv_world'\?\)"),
        ('real_mtv_world', 'give --real FOLDER and --real-view'),
        ('real_mtv_world_after_simulation', 'give --real FOLDER and --real-view'),
    ],
)
def test_rows_that_cannot_be_trained_are_refused(tables: ModuleType, rows: str, message: str):
    with pytest.raises(ConfigError, match=message):
        tables.chosen_rows([rows], has_real=False)


def test_a_row_that_starts_from_another_needs_its_stage(
    tables: ModuleType, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    name = 'real_mtv_world_after_simulation'
    words = ['--out', str(tmp_path), '--data', str(data), '--clips', '8', '--real', str(data),
             '--real-view', 'ext1']  # fmt: skip
    with pytest.raises(ConfigError, match='give --real-init CLIPS'):
        tables.chosen_rows([name], has_real=True)
    assert name not in [row.name for row in tables.chosen_rows(None, has_real=True)]

    options = tables.parser().parse_args([*words, '--real-init', '8'])
    run = tables.PaperTables(options, Recorder(lambda words: 1))
    last = run.rows[-1]
    assert last.name == name
    with pytest.raises(ConfigError, match=r"'mtv_world' with 8 clips .* not trained so far"):
        run._training(last, 0, 8)

    # in this run it waits for that stage; where no row of the run will have it nothing begins
    run._check_before()
    begun = []
    monkeypatch.setattr(run, '_do_stage', lambda row, seed, stage: begun.append(row.name))
    assert run._try([(8, 0, last), (8, 0, run.rows[0])]) == [(8, 0, last)]
    assert begun == [run.rows[0].name]
    for more in (['--rows', name], ['--clips', '4']):
        options = tables.parser().parse_args([*words, '--real-init', '8', *more])
        with pytest.raises(ConfigError, match='not trained so far'):
            tables.PaperTables(options)._check_before()


def test_weights_of_another_network_are_refused_before_anything_is_trained(
    tables: ModuleType, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    weights, nothing = tmp_path / 'other.safetensors', Recorder(lambda words: 1)
    save_file({'conv.weight': torch.zeros(3)}, weights)
    for option in ('--fid-weights', '--fvd-weights'):
        words = words_of(tmp_path / 'out', data, ROWS, option, str(weights))
        assert tables.main(words, nothing) == 1
        assert str(weights) in capsys.readouterr().err
    assert nothing.commands == []


def test_a_device_that_is_not_there_is_refused_before_anything_is_trained(
    tables: ModuleType, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    nothing = Recorder(lambda words: 1)
    words = words_of(tmp_path / 'out', data, ROWS, '--device', 'cuda:99')
    assert tables.main(words, nothing) == 1
    assert "device 'cuda:99' cannot be used" in capsys.readouterr().err
    assert nothing.commands == []


def test_a_control_whose_package_is_missing_is_named_before_anything_is_trained(
    tables: ModuleType,
    data: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setitem(sys.modules, 'tokenizers', None)
    monkeypatch.delitem(sys.modules, 'mtv_world_ros.control.fast_tokens', raising=False)
    nothing = Recorder(lambda words: 1)
    assert tables.main(words_of(tmp_path / 'out', data, 'ee_mlp,fast_tokens'), nothing) == 1
    assert "control 'fast_tokens' cannot be imported" in capsys.readouterr().err
    assert nothing.commands == []


def test_all_rows_have_the_same_budget_and_differ_in_what_they_are_named_after(
    tables: ModuleType, data: Path, tmp_path: Path
):
    """The words of every training: clips over the batch's size, control, views and mask."""
    options = tables.parser().parse_args(
        ['--out', str(tmp_path), '--data', str(data), '--clips', '8000', '--real', str(data),
         '--real-view', 'ext1', '--device', 'cuda']
    )  # fmt: skip
    run = tables.PaperTables(options, Recorder(lambda words: 1))
    found = {row.name: ' '.join(run._training(row, 0, 8000)) for row in run.rows}
    assert len(found) == len(tables.ROWS) - 1  # without --real-init
    assert all('optimizer.steps=4000' in words for words in found.values())
    assert all('--device cuda ' in words for words in found.values())
    for control in ('policy2vec', 'ee_mlp', 'fast_tokens'):
        assert [n for n, words in found.items() if f'video.control={control}' in words] == [
            row.name for row in tables.ROWS if row.control == control
        ]
    assert 'video.views=[high] ' in found['policy2vec']
    assert 'video.views=[low] ' in found['single_view_low']
    assert [n for n, words in found.items() if 'object_mask=false' in words] == ['without_mask']
    real = found['real_mtv_world']
    assert 'video.views=[ext1] ' in real and 'robot/robot.yaml' in real


class Scored(NamedTuple):
    """A stand-in for an episode's result, as far as differences of rows read it."""

    episode: str
    j: float

    def means(self, view: str) -> dict[str, float]:
        """Return J of a view; `high` is .1 less."""
        value = self.j - 0.1 * (view == 'high')
        return {'j_union': value, 'j_moving': value / 2}


def evaluated(scores: dict[str, float], reacts: bool) -> SimpleNamespace:
    """Return an evaluation with J by episode, as far as differences of rows read it."""
    low = 0.1 if reacts else -0.1
    margin = Estimate(value=0.2, interval=(low, 0.3), num_episodes=len(scores))
    return SimpleNamespace(
        results=[Scored(episode, j) for episode, j in scores.items()],
        estimates=lambda view: {'margin_over_shuffled': margin},
    )


def test_the_order_of_two_rows_is_told_from_episodes_that_both_have(
    tables: ModuleType, tmp_path: Path
):
    """Differences .02, .03, .04: mean .03, standard error .01/sqrt(3), t(2) = 4.303."""
    run = tables.PaperTables(tables.parser().parse_args(['--out', str(tmp_path)]))
    less = {'a': 0.50, 'b': 0.60, 'c': 0.70, 'd': float('nan')}
    more = {'a': 0.52, 'b': 0.63, 'c': 0.74, 'd': 0.9, 'e': 0.1}

    def results(**rows: tuple[dict[str, float], bool]) -> object:
        found = tables.Results(run, 500)
        found._read = {(name, 0, 'test'): evaluated(*row) for name, row in rows.items()}
        return found

    def verdicts(found: Any) -> dict[tuple[str, ...], list[str]]:
        return {tuple(row[:3]): row[3:] for row in found.order().rows}

    usual = results(
        without_mask=(less, True),
        mtv_world=(more, True),
        fast_tokens=({'a': 0.52, 'b': 0.63, 'c': 0.64}, False),
    )
    found = usual.difference('mtv_world', 'without_mask', 'low', 'j_union')
    assert found.num_episodes == 3 and found.value == pytest.approx(0.03)
    half = 4.303 * 0.01 / 3**0.5
    assert found.interval == pytest.approx((0.03 - half, 0.03 + half), abs=1e-5)
    pair = 'mtv_world', 'without_mask', 'high'
    assert verdicts(usual)[pair] == ['2.4', '3', '3.0 [0.5, 5.5]', '1.5 [0.3, 2.7]', 'confirmed']
    assert verdicts(usual)['mtv_world', 'fast_tokens', 'low'][-1] == 'cannot be told'  # 0, 0, .1
    assert verdicts(usual)['mtv_world', 'policy2vec', 'high'][1:] == ['–'] * 4
    turned = results(without_mask=(more, True), mtv_world=(less, False))
    assert verdicts(turned)[pair][-1] == 'contradicted'
    still = results(without_mask=(less, False), mtv_world=(more, False))
    assert verdicts(still)[pair][-1] == 'neither reacts'


def test_an_episode_of_a_row_with_two_seeds_is_one_episode_of_a_difference(
    tables: ModuleType, tmp_path: Path
):
    words = ['--out', str(tmp_path), '--seeds', '0,1']
    found = tables.Results(tables.PaperTables(tables.parser().parse_args(words)), 500)
    found._read = {
        ('without_mask', 0, 'test'): evaluated({'a': 0.5, 'b': 0.6}, True),
        ('mtv_world', 0, 'test'): evaluated({'a': 0.6, 'b': 0.6}, True),
        ('mtv_world', 1, 'test'): evaluated({'a': 0.8, 'b': 0.8}, True),
    }
    rows = {row.name: row for row in tables.ROWS}
    assert found.has(rows['without_mask']) and found.has(rows['mtv_world'])
    assert not found.has(rows['ee_mlp'])
    gain = found.difference('mtv_world', 'without_mask', 'low', 'j_union')
    assert gain.num_episodes == 2 and gain.value == pytest.approx((0.2 + 0.1) / 2)
    del found._read['mtv_world', 0, 'test']
    assert not found.has(rows['mtv_world'])


def test_real_recordings_are_split_three_to_one(
    tables: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for index in range(8):
        folder = tmp_path / 'lab' / f'{index:04d}'
        folder.mkdir(parents=True)
        (folder / 'metadata.yaml').write_text('{}')
    options = tables.parser().parse_args(
        ['--out', str(tmp_path / 'out'), '--real', str(tmp_path / 'lab'), '--real-view', 'ext1']
    )
    tables.PaperTables(options)._split_real()
    counts = [len(list((tmp_path / 'out' / n).iterdir())) for n in ('real_train', 'real_test')]
    assert counts == [6, 2]


def test_the_mean_over_tasks_weighs_tasks_alike_whatever_number_of_episodes_they_have(tables):
    found = tables.mean_over_groups([[0.8, 0.8, 0.9, 0.7], [0.2, 0.4], [float('nan')]])
    assert found.value == pytest.approx((0.8 + 0.3) / 2) and found.num_episodes == 6
    # standard errors sqrt(.02 / 3 / 4) and .1, four degrees of freedom (t table: 2.776)
    half = 2.776 * ((0.02 / 3 / 4 + 0.01) ** 0.5) / 2
    assert found.interval == pytest.approx((0.55 - half, 0.55 + half), abs=1e-3)


def test_one_episode_of_a_task_leaves_the_mean_over_tasks_without_an_interval(tables):
    found = tables.mean_over_groups([[0.8], [0.2, 0.4]])
    assert found.value == pytest.approx(0.55) and found.interval[0] != found.interval[0]


def test_a_row_of_another_method_version_is_refused_by_name(tables, tmp_path: Path):
    row = next(row for row in tables.ROWS if row.name == 'ee_mlp')
    (tmp_path / 'training').mkdir()
    with pytest.raises(ConfigError, match=r"row 'ee_mlp' .*version 1.*version 2.*--out"):
        tables.check_method(tmp_path, row)
    (tmp_path / 'training').rmdir()
    tables.check_method(tmp_path, row)
    (tmp_path / 'training').mkdir()
    tables.check_method(tmp_path, row)  # its own method, again


def test_a_folder_with_a_row_of_another_method_version_is_refused_before_anything_is_done(
    tables, data: Path, tmp_path: Path, capsys
):
    """Also where another row is asked for, as the tables read all that are there."""
    (tmp_path / 'rows' / 'ee_mlp' / 'seed_1' / 'training').mkdir(parents=True)
    (tmp_path / 'settings.json').write_text('{"tasks": []}')  # of version 1, without `rates`
    recorder = Recorder()
    assert tables.main(words_of(tmp_path, data, 'mtv_world'), recorder) == 1
    assert not recorder.commands
    said = capsys.readouterr().err
    assert "row 'ee_mlp' in '" in said and 'version 1' in said and '--out' in said


def test_the_learning_rate_with_the_lowest_loss_is_taken(tables, data: Path, tmp_path: Path):
    losses = {0.0003: 0.5, 0.0006: 0.2, 0.0012: 0.4}

    def train(words: list[str]) -> int:
        folder = Path(words[words.index('--out') + 1])
        folder.mkdir(parents=True)
        rate = float(next(w for w in words if '.learning_rate=' in w).rpartition('=')[2])
        lines = [json.dumps({'step': k, 'loss': losses[rate]}) for k in range(8)]
        (folder / 'log.jsonl').write_text('\n'.join(lines) + '\n')
        return 0

    options = tables.parser().parse_args(
        words_of(tmp_path, data, ROWS, '--rates', '3e-4,6e-4,1.2e-3', '--rate-clips', '2',
                 '--seeds', '0,1')
    )  # fmt: skip
    run = tables.PaperTables(options, train)
    row = next(row for row in tables.ROWS if row.name == 'mtv_world')
    first, second = run.folder(row, 0), run.folder(row, 1)
    assert run._find_rate(row, 0, 'mtv_world') == 0.0006
    assert sorted(p.name for p in first.glob('rate_*')) == ['rate_0.0003', 'rate_0.0012']
    assert json.loads((first / 'training' / 'log.jsonl').read_text().split('\n')[0])['loss'] == 0.2
    # the second seed takes the rate of the first, and nothing is tried again
    losses.clear()
    assert run._find_rate(row, 0, 'mtv_world') == run._find_rate(row, 1, 'mtv_world') == 0.0006
    assert not second.exists()
    words = run._training(row, 0, 4, 0.0006)
    assert '--set=optimizer.learning_rate=0.0006' in words
