import csv
import json
import shutil
from typing import Any

import numpy as np
import pytest

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.errors import ConfigError, EpisodeError, TrajectoryError
from mtv_world_ros.core.files import plain
from mtv_world_ros.evaluation import episode_scorer
from mtv_world_ros.evaluation.evaluate_episodes import evaluate
from mtv_world_ros.evaluation.references import with_actions
from mtv_world_ros.evaluation.settings import EvaluationConfig
from mtv_world_ros.model.autoencoders import SpaceToDepthAutoencoder
from test.support.own_task import shift_right_episode
from test.support.small_episodes import OracleWorldModel

#: reason of an estimate without a task
_UNKNOWN = 'is no known task'


def run(pipeline, episodes, out, *, name='', zero_shot=None, overwrite=False, **config):
    evaluate(
        pipeline,
        episodes,
        out,
        EvaluationConfig(**config),
        name=name,
        zero_shot=zero_shot or {},
        overwrite=overwrite,
        show_progress=False,
    )
    return json.loads((out / 'metrics.json').read_text()), (out / 'tables.md').read_text()


@pytest.fixture(scope='module')
def held(make_pipeline, episodes, tmp_path_factory):
    """Folder, metrics and tables of the model that holds the first frame."""
    out = tmp_path_factory.mktemp('held')
    return out, *run(make_pipeline(), episodes, out)


@pytest.fixture(scope='module')
def perfect(make_pipeline, episodes, recordings, tmp_path_factory):
    """Folder and metrics of the model that knows the future; its results have a name."""
    out = tmp_path_factory.mktemp('perfect')
    return out, run(make_pipeline(OracleWorldModel(recordings)), episodes, out, name='oracle')[0]


@pytest.mark.slow
@pytest.mark.parametrize('mode', ['observe', 'imagine'])
def test_persistence_model_scores_exactly_the_persistence_baseline(
    make_pipeline, episodes, tmp_path, mode
):
    metrics, _ = run(make_pipeline(), episodes, tmp_path, mode=mode)
    assert metrics['num_episodes'] == 3 and set(metrics['views']) == {'low', 'high'}
    for view in metrics['views'].values():
        assert view['j_moving'] == view['j_copy_moving'] == view['j_shuffled_moving'] < 0.8
        assert view['j_object_mean'] == view['j_copy_mean']
        assert view['skill'] == view['margin_moving'] == 0.0


@pytest.mark.slow
def test_recorded_frames_score_the_ceiling(make_pipeline, episodes, oracle, tmp_path):
    oracle.autoencoder = SpaceToDepthAutoencoder()
    metrics, _ = run(make_pipeline(oracle), episodes, tmp_path)
    for view in metrics['views'].values():
        assert view['j_object_mean'] == view['j_union'] == view['j_moving'] == 1.0
        assert view['j_ceiling'] == 1.0 and view['skill'] == 1.0
        assert view['intervals']['margin_moving'][0] > 0.2


def test_score_collapses_when_actions_are_shuffled(perfect):
    for view in perfect[1]['views'].values():
        assert view['j_shuffled_moving'] == view['j_copy_moving']
        assert view['margin_over_shuffled'] > 0.2


def test_blur_costs_some_but_not_all(make_pipeline, episodes, blurred_oracle, tmp_path):
    metrics, _ = run(make_pipeline(blurred_oracle), episodes, tmp_path)
    assert 0.8 < metrics['overall']['j_moving'] < 1.0


def test_what_is_not_measured_is_null(make_pipeline, episodes, tmp_path):
    metrics, _ = run(make_pipeline(), episodes, tmp_path, actions=('true',))
    low = metrics['views']['low']
    assert low['fid'] is None and low['fvd'] is None
    assert low['j_ceiling'] is None and low['j_shuffled_moving'] is None
    assert low['intervals']['j_shuffled_moving'] == [None, None]


@pytest.mark.slow
def test_scores_against_true_masks_need_no_perfect_segmenter(
    make_pipeline, episodes, blurred_oracle, tmp_path
):
    metrics, text = run(make_pipeline(blurred_oracle), episodes, tmp_path)
    assert 0.7 < metrics['overall']['j_object_mean'] < 1.0
    assert metrics['num_episodes_with_true_masks'] == 3 and "the simulator's masks" in text
    own, text = run(make_pipeline(blurred_oracle), episodes, tmp_path, use_ids=False)
    assert own['num_episodes_with_true_masks'] == 0 and "segmenter's own masks" in text
    assert own['overall']['j_self'] == 1.0  # truth is the segmenter itself
    both = metrics['overall']
    assert both['jf_moving'] == pytest.approx((both['j_moving'] + both['f_moving']) / 2, abs=1e-5)
    assert "simulator's" in metrics['moving_rule']


def test_files_hold_every_row(held):
    out, metrics, table = held
    rows = list(csv.DictReader((out / 'rows.csv').open()))
    objects = [row for row in rows if row['name'] != '(union)']
    assert len(objects) == metrics['overall']['num_rows'] == 3 * 2 * 2 * 2
    assert {row['moving'] for row in objects if row['name'] == 'blue block'} == {'False'}
    assert {row['moving'] for row in objects if row['name'] == 'red block'} == {'True'}
    assert '| low ' in table and 'place_block_a2b_left · high' in table


def test_object_outside_the_palette_is_not_scored_and_says_so(
    make_pipeline, make_episode, tmp_path
):
    path = make_episode(tmp_path / 'episode', objects=('red block', 'wooden spoon'))
    for use_ids, status in ((True, 'predicted'), (False, 'true')):
        metrics, table = run(make_pipeline(), [path], tmp_path / status, use_ids=use_ids)
        low = metrics['views']['low']
        assert low['num_not_scored'] == 2
        assert low['status'][f'{status}: out_of_palette'] == 2
    assert '| true: out_of_palette | 2   | 2    |' in table


def test_object_that_the_model_loses_scores_0_and_says_so(make_pipeline, episodes, tmp_path):
    class Eraser:
        spec = make_pipeline().spec

        def predict(self, start_frame, control, **_):
            frames = np.repeat(start_frame[:, None], 4, axis=1)
            frames[..., :] = 170
            return frames

    metrics, _ = run(make_pipeline(Eraser()), episodes, tmp_path)
    low = metrics['views']['low']
    assert low['j_object_mean'] == 0.0 and low['num_not_scored'] == 0
    assert set(low['status']) == {'predicted: lost'}


def test_finished_episodes_are_not_imagined_again(
    make_pipeline, episodes, oracle, perfect, tmp_path
):
    (finished, first), out, pipeline = perfect, tmp_path / 'out', make_pipeline(oracle)
    shutil.copytree(finished, out)
    again, _ = run(pipeline, episodes, out, name='oracle')
    assert oracle.num_calls == 0 and again == first
    with pytest.raises(ConfigError, match='other settings .seed 0, now 1'):
        run(pipeline, episodes, out, name='oracle', seed=1)
    assert oracle.num_calls == 0
    run(pipeline, episodes, out, name='oracle', seed=1, overwrite=True)
    assert oracle.num_calls == 3 * 2 * 2


def test_an_episode_is_judged_by_the_task_that_it_defines(make_pipeline, make_episode, tmp_path):
    """Without the task's file; results of another definition are not taken over."""
    pipeline, data, out = make_pipeline(), tmp_path / 'data', tmp_path / 'out'
    path = make_episode(data / 'own', **shift_right_episode(tmp_path))
    options = {'name': 'own', 'actions': ('true',), 'ceiling': False, 'mode': 'imagine'}

    def judged():
        run(pipeline, [path], out, **options)
        return json.loads((out / 'episodes' / 'own.json').read_text())

    first = judged()
    assert first['settings']['task']['name'] == 'shift_right'
    assert not any(_UNKNOWN in reason for reason in first['result']['reasons'])
    assert judged() == first
    shutil.rmtree(path)
    make_episode(data / 'own', **shift_right_episode(tmp_path, distance_m=0.2))
    assert judged()['settings']['task'] != first['settings']['task']
    shutil.rmtree(path)
    make_episode(data / 'own', **{**shift_right_episode(tmp_path), 'metadata': {}})
    undefined = judged()
    assert 'task' not in undefined['settings'] and _UNKNOWN in undefined['result']['reasons'][0]


class Turn:
    """One of two processes; the other one's values are given, or do not count."""

    count = 2

    def __init__(self, number: int, other: list[Any]) -> None:
        self.number, self.other, self.given = number, other, []

    def of_all(self, value: Any) -> list[Any]:
        self.given.append(value)
        return [value, *self.other]


def test_processes_share_the_episodes_and_the_first_one_writes_the_summary(
    make_pipeline, recordings, episodes, tmp_path
):
    paths, options = [*episodes, tmp_path / 'nothing'], EvaluationConfig(actions=('true',))

    def scored(out, peers=None):
        oracle = OracleWorldModel(recordings)
        summary = evaluate(
            make_pipeline(oracle), paths, out, options, peers=peers, show_progress=False
        )
        return {**summary.metrics, 'provenance': None}, oracle.num_calls

    whole, num_calls = scored(tmp_path / 'whole')
    helper = Turn(1, [([], {})])
    assert 0 < scored(tmp_path / 'out', helper)[1] < num_calls
    assert not (tmp_path / 'out' / 'metrics.json').exists()
    found, rest = scored(tmp_path / 'out', Turn(0, helper.given))
    assert 0 < rest < num_calls
    others = {key for key in whole if key.startswith('seconds')} | {'real_time_factor'}
    for key in whole.keys() - others:
        assert plain(found[key]) == plain(whole[key]), key
    assert read_json(tmp_path / 'out' / 'metrics.json')['num_episodes_failed'] == 1


def test_results_without_a_name_are_not_taken_over(
    make_pipeline, episodes, oracle, held, tmp_path
):
    shutil.copytree(held[0], tmp_path / 'out')
    run(make_pipeline(oracle), episodes, tmp_path / 'out')
    assert oracle.num_calls == 3 * 2 * 2


def test_half_written_result_is_scored_again(make_pipeline, episodes, tmp_path):
    run(make_pipeline(), episodes[:1], tmp_path, name='x')
    file = tmp_path / 'episodes' / 'episode_0.json'
    file.write_text(file.read_text()[:100])
    metrics, _ = run(make_pipeline(), episodes[:1], tmp_path, name='x')
    assert metrics['num_episodes'] == 1


def test_unusable_episode_is_listed_with_its_reason(make_pipeline, episodes, tmp_path):
    missing = tmp_path / 'nothing'
    metrics, table = run(make_pipeline(), [*episodes[:1], missing], tmp_path / 'out')
    assert metrics['num_episodes'] == 1 and metrics['num_episodes_failed'] == 1
    assert str(missing) in metrics['failed'] and 'not scored' in table


def test_no_usable_episode_is_an_error(make_pipeline, tmp_path):
    with pytest.raises(EpisodeError, match='no episode could be scored'):
        run(make_pipeline(), [tmp_path / 'nothing'], tmp_path / 'out')
    with pytest.raises(EpisodeError, match='none was given'):
        run(make_pipeline(), [], tmp_path / 'out')


def test_unknown_mode_or_option_is_an_error(make_pipeline, episodes, tmp_path):
    with pytest.raises(ConfigError, match='mode .*observe, imagine'):
        run(make_pipeline(), episodes[:1], tmp_path, mode='observed')
    with pytest.raises(ConfigError, match='sed'):
        run(make_pipeline(), episodes[:1], tmp_path, sed=1)


def test_success_estimates_are_compared_with_the_outcome(held):
    _, metrics, _ = held
    assert metrics['success']['num_outcomes_known'] == 3
    assert metrics['success']['real_success_rate'] == pytest.approx(2 / 3)
    assert metrics['seconds_per_chunk'] > 0


def test_every_number_has_an_interval_beside_it(held):
    _, metrics, _ = held
    for view in metrics['views'].values():
        named = {'j_object_mean', 'j_union', 'j_moving', 'j_copy_moving', 'j_shuffled_moving'}
        named |= {'skill', 'j_visible', 'j_ceiling', 'fid', 'fvd', 'psnr', 'ssim', 'lpips'}
        assert named <= set(view) and named <= set(view['intervals'])
        low, high = view['intervals']['j_moving']
        assert low <= view['j_moving'] <= high
        assert view['psnr'] is view['intervals']['psnr'][0] is None


def test_j_by_frame_falls_as_the_held_frame_ages_and_has_a_band(make_pipeline, episodes, tmp_path):
    metrics, table = run(make_pipeline(), episodes, tmp_path, mode='imagine')
    low = metrics['views']['low']
    assert len(low['j_moving_by_frame']) == len(low['j_moving_by_frame_interval']) == 9
    assert low['j_moving_by_frame'] == sorted(low['j_moving_by_frame'], reverse=True)
    assert low['j_moving_by_frame'] == low['j_copy_moving_by_frame']
    band = low['j_moving_by_frame_interval'][0]
    assert band[0] < low['j_moving_by_frame'][0] < band[1]
    num = metrics['model']['num_frames']
    chunks = [low['j_moving_by_frame'][k : k + num] for k in range(0, 9, num)]
    assert low['j_moving_by_chunk'] == pytest.approx([np.mean(c) for c in chunks], abs=1e-5)
    assert len(low['j_moving_by_chunk_interval']) == len(chunks) > 1
    assert 'J of objects that move, chunk' in table


def test_held_actions_are_scored_beside_the_true_ones(make_pipeline, episodes, oracle, tmp_path):
    actions = ('true', 'shuffled', 'zero')
    metrics, table = run(make_pipeline(oracle), episodes, tmp_path, actions=actions)
    for view in metrics['views'].values():
        # under any other actions the oracle holds the first frame
        for name in ('zero', 'shuffled'):
            assert view[f'j_{name}_moving'] == view['j_copy_moving']
        assert view['margin_of_shuffled'] == 0.0 and view['j_self'] == 1.0
    assert 'imagined, joints held' in table
    assert metrics['actions'] == list(actions)


def test_actions_that_cannot_be_imagined_are_noted_and_not_scored(
    make_pipeline, episodes, tmp_path, monkeypatch
):
    def out_of_reach(name, recording, *_):
        if name == 'zero':
            raise TrajectoryError('out of reach')
        return recording

    monkeypatch.setattr(episode_scorer, 'with_actions', out_of_reach)
    metrics, table = run(make_pipeline(), episodes[:1], tmp_path / 'out', actions=('true', 'zero'))
    assert metrics['views']['low']['j_zero_moving'] is None
    assert metrics['views']['low']['j_moving'] is not None
    (notes,) = metrics['notes'].values()
    said = 'zero actions: 2 of 2 chunks (from 0.0, 0.8 s on) were not imagined: out of reach'
    assert notes == [said] and said in table


def test_margins_are_over_the_chunks_that_were_imagined_with_other_commands(
    make_pipeline, episodes, oracle, tmp_path, monkeypatch
):
    """Other commands cannot be executed from the second chunk on: no margin is of these."""

    def reached_at_first(name, recording, stretch, donor):
        if name == 'shuffled' and stretch.index:
            raise TrajectoryError('joints would jump')
        return with_actions(name, recording, stretch, donor)

    monkeypatch.setattr(episode_scorer, 'with_actions', reached_at_first)
    metrics, table = run(make_pipeline(oracle), episodes, tmp_path)
    one, every = len(episodes), metrics['num_chunks']
    assert metrics['num_chunks_with_other_commands'] == one < every
    assert f'{one} of {every} were imagined with other commands' in table
    file = tmp_path / 'episodes' / f'{episodes[0].name}.json'
    rows = json.loads(file.read_text())['result']
    assert {'psnr_over_held', 'psnr_over_shuffled'} <= rows['pictures']['low'].keys()
    scored = [row for row in rows['rows'] if row['view'] == 'low' and row['name']]
    assert {row['stretch'] for row in scored if row['j_shuffled'] is not None} <= {0}
    (note,) = rows['notes']
    assert note.startswith(f'shuffled actions: {every // one - 1} of {every // one} chunks (')
    assert 'were not imagined and have no margins: joints would jump' in note


def test_an_episode_without_others_says_that_none_lends_its_commands(
    make_pipeline, episodes, tmp_path
):
    metrics, table = run(make_pipeline(), episodes[:1], tmp_path)
    ((note,),) = metrics['notes'].values()
    assert note == 'no frames were imagined with other commands: there is no other episode'
    assert 'Margins are over the held frame alone' in table


def test_true_frames_score_the_segmenters_own_ceiling_against_the_simulators_masks(
    make_pipeline, episodes, tmp_path
):
    metrics, table = run(make_pipeline(), episodes, tmp_path, use_ids=True)
    assert 0.8 < metrics['overall']['j_self_moving'] <= 1.0
    assert metrics['overall']['j_ceiling'] is None  # no autoencoder
    assert 'recorded frames' in table and 'through the autoencoder' not in table


def test_ceiling_is_not_measured_unless_asked_for(make_pipeline, episodes, tmp_path):
    metrics, _ = run(make_pipeline(), episodes[:1], tmp_path, ceiling=False)
    assert metrics['overall']['j_self'] is None


def test_quality_of_pictures_is_measured_by_view(make_pipeline, episodes, oracle, tmp_path):
    quality = ('psnr', 'ssim')
    perfect, table = run(make_pipeline(oracle), episodes[:2], tmp_path / 'a', quality=quality)
    still, _ = run(make_pipeline(), episodes[:2], tmp_path / 'b', quality=quality)
    for view in ('low', 'high'):
        assert perfect['views'][view]['ssim'] == pytest.approx(1, abs=1e-3)
        assert still['views'][view]['ssim'] < 0.99
        assert still['views'][view]['psnr'] < 30 < perfect['views'][view]['psnr']
    assert 'PSNR [dB]' in table


def test_damaged_episode_is_noted_or_listed_never_scored_in_silence(
    make_pipeline, make_episode, episodes, tmp_path
):
    cut, garbage = make_episode(tmp_path / 'cut'), make_episode(tmp_path / 'garbage')
    file = next(cut.glob('*.mcap'))
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * 0.9)])
    next(garbage.glob('*.mcap')).write_bytes(b'no recording at all')
    metrics, table = run(make_pipeline(), [*episodes[:1], cut, garbage], tmp_path / 'out')
    assert list(metrics['failed']) == [str(garbage)] and str(garbage) in table
    assert metrics['notes']['cut'] and 'cut' in table
    assert metrics['num_episodes'] == 2 and metrics['num_episodes_failed'] == 1


def test_time_of_an_episode_is_split_by_stage(held):
    seconds = held[1]['seconds_per_episode']
    stages = {'reading', 'imagining', 'segmenting', 'scoring', 'features', 'storing'}
    assert set(seconds) == stages
    assert seconds['imagining'] > 0 and seconds['segmenting'] > 0


@pytest.mark.parametrize(
    ('outcome', 'probability', 'seen'),
    [
        ('success', 0.1, 'failure'),
        ('failure', 0.9, 'success'),
        ('success', 0.4, ''),
        ('failure', 0.6, ''),
        ('unknown', 0.01, ''),
        ('success', float('nan'), ''),
    ],
)
def test_a_label_that_recorded_frames_clearly_contradict_is_named(outcome, probability, seen):
    said = episode_scorer.contradiction(outcome, probability)
    assert (f'labelled a {outcome}, but its recorded frames look like a {seen} ' in said) == bool(
        seen
    )
    assert bool(said) == bool(seen)
