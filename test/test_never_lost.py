"""Nothing that exists is replaced unasked, a stopped training goes on, mistakes get one line."""

from __future__ import annotations

from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
import json
import os
from pathlib import Path
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time

import pytest
import torch

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import check_free, share_path, write_json
from mtv_world_ros.evaluation.result_settings import check_same_settings

ROOT = Path(__file__).parents[1]
EPISODE = share_path('resource', 'demo_episode')
#: of the preset `small`, made tiny
TINY = {
    'transformer': 'num_attention_heads=2 attention_head_dim=12 ffn_dim=32 num_layers=1 '
    'stem_widths=[8,16,16] frames_per_token=2 freq_dim=16',
    'video': 'num_frames=2 width=48 height=40',
    'optimizer': 'batch_size=1 warmup_steps=1',
}
SETTINGS = [w for name, v in TINY.items() for x in v.split() for w in ('--set', f'{name}.{x}')]


def train_words(out: Path, *more: str) -> list[str]:
    """A training of seconds on the bundled episode."""
    words = ['train', str(EPISODE.parent), '--out', str(out), '--dtype', 'float32']
    return [*words, '--threads', '1', *SETTINGS, *more]


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line with which a command refuses."""
    capsys.readouterr()
    assert main(words) == 1
    said = capsys.readouterr().err
    assert said.startswith('mtv-world: ') and said.count('\n') == 1, said
    return said


def test_a_file_or_a_folder_that_holds_something_is_replaced_only_when_asked(tmp_path):
    check_free(tmp_path / 'new', False)
    check_free(tmp_path, False)  # empty
    file = tmp_path / 'report.html'
    file.write_text('old')
    for path in (file, tmp_path):
        with pytest.raises(ConfigError, match='exists; give another --out, or --overwrite'):
            check_free(path, False)
        check_free(path, True)


def test_results_with_other_settings_are_replaced_only_when_asked(tmp_path):
    folder = tmp_path / 'episodes'
    settings = {'name': 'a (12)', 'steps': 4}
    check_same_settings(folder, settings, False)
    write_json(folder / 'one.json', {'settings': {**settings, 'path': 'x'}, 'result': {}})
    check_same_settings(folder, settings, False)
    with pytest.raises(
        ConfigError, match=r'other settings \(steps 4, now 8\); give another --out'
    ):
        check_same_settings(folder, {**settings, 'steps': 8}, False)
    with pytest.raises(ConfigError, match='written by another version'):
        check_same_settings(folder, {**settings, 'truth': 'ids'}, False)
    check_same_settings(folder, {'name': 'b'}, True)


def test_calibrate_writes_neither_into_the_package_nor_over_a_calibration(tmp_path, capsys):
    words = [str(EPISODE.parent), '--out', str(tmp_path / 'out')]
    said = refused(['fit', 'success', 'bundled', *words], capsys)
    assert 'part of the installed package' in said and '--no-store' in said
    mine = tmp_path / 'mine'
    mine.mkdir()
    for name in ('world_model.json', 'success_calibration.json'):
        shutil.copy(share_path('resource', 'checkpoint') / name, mine)
    assert "success_calibration.json' exists" in refused(
        ['fit', 'success', str(mine), *words], capsys
    )


def test_imagined_episodes_and_predictions_stay(tmp_path, capsys):
    kept = tmp_path / 'episode_00000' / 'kept'
    kept.parent.mkdir()
    kept.write_text('')
    start = ['--episodes', str(EPISODE), '--out', str(tmp_path)]
    assert "episode_00000' exists" in refused(['imagine', *start], capsys)
    for policy, why in (('expert-mis-0.5', "did you mean 'miss'"), ('exprt', 'is not in config')):
        assert why in refused(['imagine', *start, '--policy', policy, '--overwrite'], capsys)
    offline = ['replay', str(EPISODE), '--offline', '--out', str(kept.parent)]
    assert "episode_00000' exists" in refused(offline, capsys)
    assert "episode_00000' exists" in refused(['demo', '--out', str(kept.parent)], capsys)
    assert kept.is_file()


def test_a_report_of_several_evaluations_needs_a_place_of_its_own(tmp_path, capsys):
    half = tmp_path / 'half' / 'episodes'
    half.mkdir(parents=True)
    (half / 'one.json').write_text('{}')
    page = tmp_path / 'page.html'
    page.write_text('old')
    both = ['export', 'report', str(half.parent), str(tmp_path)]
    assert '2 evaluations go into one page; give --out FILE' in refused(both, capsys)
    assert 'page.html' in refused([*both, '--out', str(page)], capsys)
    assert page.read_text() == 'old'
    assert 'is not finished' in refused(['export', 'report', str(half.parent)], capsys)


def stopped_in_a_process(words: list[str], kind: int, log: Path) -> tuple[int, str]:
    """Status and errors of a command that gets a signal once it has logged something."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'mtv_world_ros.cli', *words],
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    end = time.monotonic() + 240
    while not (log.is_file() and log.read_text()):
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.1)
    process.send_signal(kind)
    said = process.communicate(timeout=120)[1]
    return process.returncode, said


def stopped_here(words: list[str], kind: int, log: Path) -> tuple[int, str]:
    """The same without a process of its own."""
    ended, said = threading.Event(), StringIO()

    def stop() -> None:
        while not ended.wait(0.05):
            if log.is_file() and log.read_text():
                os.kill(os.getpid(), kind)
                return

    thread = threading.Thread(target=stop)
    thread.start()
    try:
        with redirect_stderr(said):
            status = main(words)
    finally:
        ended.set()
        thread.join()
    return status, said.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize(
    ('kind', 'stopped'),
    [(signal.SIGINT, stopped_in_a_process), (signal.SIGTERM, stopped_here)],
)
def test_a_signal_saves_the_training_and_says_how_to_go_on(kind, stopped, tmp_path, capsys):
    out = tmp_path / 'run'
    words = train_words(out, '--set', 'optimizer.steps=100000', '--save-every', '1000000')
    status, errors = stopped(words, kind, out / 'log.jsonl')
    said = errors.splitlines()[-1]
    assert status == 128 + kind, errors
    step = json.loads((out / 'state' / 'state.json').read_text())['step']
    assert step >= 10
    assert said.startswith(f'mtv-world: stopped at step {step} of 100000, which is saved in ')
    again = shlex.split(said.partition('; go on with: ')[2])
    assert again == ['mtv-world', *words]
    # the command that it printed goes on, here for two steps more
    capsys.readouterr()
    assert main([*again[1:], '--set', f'optimizer.steps={step + 2}']) == 0
    assert f'resumed at step {step}' in capsys.readouterr().out
    card = json.loads((out / 'checkpoint' / 'world_model.json').read_text())
    assert card['trained_on']['steps'] == step + 2


@pytest.fixture(scope='module')
def trained(tmp_path_factory) -> tuple[Path, str]:
    """A training of two steps, and what it printed."""
    out, said = tmp_path_factory.mktemp('trained') / 'run', StringIO()
    with redirect_stdout(said):
        assert main(train_words(out, '--set', 'optimizer.steps=2')) == 0
    return out, said.getvalue()


@pytest.mark.slow
def test_the_evaluation_that_train_prints_runs(trained):
    out, said = trained
    line, note = said.partition('evaluate it with: ')[2].splitlines()[:2]
    assert note.startswith(
        '(EPISODES: a folder of episodes that it was not trained on; it was on '
    )
    words = shlex.split(line.replace('EPISODES', str(EPISODE.parent)))
    assert words[:2] == ['mtv-world', 'evaluate']
    assert main([*words[1:], '--no-report', '--no-ceiling', '--actions', 'true']) == 0
    assert (out / 'evaluation_2' / 'metrics.json').is_file()


def test_resuming_another_architecture_is_refused_before_anything_is_touched(trained, capsys):
    out, _ = trained
    before = {path: path.stat().st_mtime_ns for path in out.rglob('*')}
    more = ['--set', 'optimizer.steps=4']
    said = refused(train_words(out, *more, '--set', 'transformer.num_layers=2'), capsys)
    assert 'was trained with transformer.num_layers 1, this preset has 2' in said
    said = refused(train_words(out, *more, '--views', 'low'), capsys)
    assert 'transformer.num_views 2, this preset has 1' in said
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob('*')}


@pytest.mark.parametrize(
    ('more', 'message'),
    [
        (['--set', 'optimizer.steps=abc'], "optimizer.steps is 'abc'; it must be a whole number"),
        (['--set', 'optimizer.steps=['], "'[' is not a YAML value"),
        (['--device', 'gpu'], "device 'gpu' is not known; e.g. cpu, cuda"),
        (['--init', 'nowhere'], "'nowhere' is not a checkpoint"),
        pytest.param(
            ['--device', 'cuda'],
            "device 'cuda' cannot be used: torch ",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason='there is a GPU'),
        ),
    ],
)
def test_wrong_values_get_one_line(more, message, tmp_path, capsys):
    assert message in refused(train_words(tmp_path / 'run', *more), capsys)
    assert not (tmp_path / 'run' / 'state').exists()


def test_states_are_saved_by_time_too(tmp_path):
    words = train_words(tmp_path, '--set', 'optimizer.steps=3', '--save-minutes', '0')
    seen = []
    from mtv_world_ros.training.trainer import Trainer

    save = Trainer.save_state
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, 'save_state', lambda self: (seen.append(self.step), save(self)))
        assert main(words) == 0
    assert seen == [1, 2, 3]


def test_the_version_is_that_of_package_xml(capsys):
    with pytest.raises(SystemExit) as end:
        main(['--version'])
    assert end.value.code == 0
    version = capsys.readouterr().out.split()[1]
    assert f'<version>{version}</version>' in (ROOT / 'package.xml').read_text()


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['trian', 'x'], "there is no command 'trian' (did you mean 'train'?)"),
        (['evaluate', 'a', 'b', '--out', 'c', '--devise', 'cpu'], "(did you mean '--device'?)"),
    ],
)
def test_what_is_mistyped_gets_its_nearest(words, message, capsys):
    with pytest.raises(SystemExit):
        main(words)
    assert message in capsys.readouterr().err
