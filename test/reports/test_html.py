import base64
from html.parser import HTMLParser
import json
import re

import av
import cv2
import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.evaluation.evaluate_episodes import DEFAULTS, evaluate
from mtv_world_ros.evaluation.results import rollout_path
from mtv_world_ros.evaluation.settings import EvaluationConfig
from mtv_world_ros.reports.charts import (
    ChartLine,
    Dot,
    dot_chart,
    line_chart,
    Point,
    scatter_chart,
)
from mtv_world_ros.reports.comparison import write_comparison
from mtv_world_ros.reports.evaluation_page import write_report
from mtv_world_ros.viewing.rollout_clips import make_clip, outlined, OUTLINES
from mtv_world_ros.viewing.stored_rollout import load_rollout

EVIL_NAME = '<script>alert("name")<x onload=y>'
EVIL_EPISODE = 'b"><script>alert(1)<img src=x onerror=e>'
EVIL_OBJECT = 'red block</td><iframe src="http:x">'
NUM_FRAMES = 8


class Page(HTMLParser):
    """Tags, attributes and text of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text = [], ''
        self.feed(str(text))

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text += data + '\n'

    def all(self, tag):
        return [attributes for found, attributes in self.tags if found == tag]


def scored(pipeline, episodes, out, config=DEFAULTS, **options):
    evaluate(pipeline, episodes, out, config, show_progress=False, **options)
    return out


def report(*folders):
    path = write_report(folders, folders[0] / 'report.html')
    return Page(path.read_text(encoding='utf-8'))


def data_of(uri, kind):
    head, _, body = uri.partition(',')
    assert head == f'data:{kind};base64'
    return base64.b64decode(body, validate=True)


def played(video, tmp_path):
    file = tmp_path / 'video.mp4'
    file.write_bytes(data_of(video['src'], 'video/mp4'))
    with av.open(str(file)) as container:
        return np.array([f.to_ndarray(format='rgb24') for f in container.decode(video=0)])


@pytest.fixture(scope='module')
def held(make_pipeline, episodes, tmp_path_factory):
    """An evaluation of the model that holds the first frame, with an episode that is missing."""
    out = tmp_path_factory.mktemp('held')
    missing = out / EVIL_EPISODE
    provenance = {'command': 'mtv-world evaluate held', 'date': '2026-11-21', 'dataset': 'there'}
    return scored(make_pipeline(), [*episodes, missing], out, name='held', provenance=provenance)


@pytest.fixture(scope='module')
def evil(make_pipeline, make_episode, tmp_path_factory):
    """An evaluation in which every name tries to be HTML."""
    out = tmp_path_factory.mktemp('evil')
    objects = (EVIL_OBJECT, 'blue block')
    episode = make_episode(out / EVIL_EPISODE, objects=objects, outcome='failure')
    return scored(
        make_pipeline(), [episode], out, name=EVIL_NAME, provenance={'machine': EVIL_NAME}
    )


@pytest.fixture(scope='module')
def page(held):
    return report(held)


def test_page_asks_nothing_of_anybody(held, evil):
    for folders in ([evil], [held, evil]):
        found = report(*folders)
        addresses = [
            value
            for _, attributes in found.tags
            for key, value in attributes.items()
            if key in ('src', 'href', 'poster', 'srcset', 'action', 'data', 'xlink:href')
        ]
        assert len(addresses) > 10
        assert all(value.startswith(('data:', '#')) for value in addresses)
        assert not {'script', 'link', 'iframe', 'object', 'base', 'form'} & {
            tag for tag, _ in found.tags
        }
        style = re.search('<style>(.*?)</style>', (folders[0] / 'report.html').read_text(), re.S)
        assert not re.search(r'url\(|@import|http', style[1])
        policy = next(m['content'] for m in found.all('meta') if 'http-equiv' in m)
        assert policy.startswith("default-src 'none'")


def test_hostile_names_are_only_text(evil):
    found = report(evil)
    for name in (EVIL_NAME, EVIL_EPISODE, EVIL_OBJECT):
        assert name in found.text
    handlers = [key for _, attributes in found.tags for key in attributes if key.startswith('on')]
    assert not handlers and not found.all('x')


def test_links_lead_to_sections(page):
    sections = {attributes.get('id') for attributes in page.all('section')}
    assert {attributes['href'][1:] for attributes in page.all('a')} == sections


def test_videos_play_whole_and_pictures_open(page, tmp_path):
    videos = page.all('video')
    assert len(videos) == len(page.all('img')) == 3
    for video in videos:
        frames = played(video, tmp_path)
        assert len(frames) == NUM_FRAMES
        assert frames.shape[1:3] == (int(video['height']), int(video['width']))
        assert frames[0].std() > 20 and (frames[0] != frames[-1]).any()
    for image in page.all('img'):
        sheet = cv2.imdecode(np.frombuffer(data_of(image['src'], 'image/webp'), np.uint8), 1)
        assert sheet.shape[0] > 200 and sheet.std() > 20


def test_best_median_and_worst_are_ranked_by_moving_objects(page):
    # the faster the block, the less the held frame fits
    for title, episode in (('Best', 0), ('Median', 1), ('Worst', 2)):
        assert f'{title}: episode_{episode} (J ' in page.text


def test_page_shows_the_numbers_of_metrics_json(held, page):
    metrics = json.loads((held / 'metrics.json').read_text())
    for view in ('low', 'high'):
        numbers = metrics['views'][view]
        low, high = numbers['intervals']['j_moving']
        assert f'{numbers["j_moving"]:.3f} [{low:.3f}, {high:.3f}]' in page.text
        assert f'{numbers["j_union"]:.3f}' in page.text
    assert metrics['success']['real_success_rate'] == pytest.approx(2 / 3, abs=1e-6)
    assert 'Real success rate\n0.667' in page.text
    for words in ('mtv-world evaluate held', '2026-11-21', 'there', 'place_block_a2b_left'):
        assert words in page.text


def test_chained_rollouts_show_how_j_falls_from_chunk_to_chunk(make_pipeline, episodes, tmp_path):
    out = scored(make_pipeline(), episodes, tmp_path, EvaluationConfig(mode='imagine'))
    found = report(out)
    overall = json.loads((out / 'metrics.json').read_text())['overall']
    values = overall['j_moving_by_chunk']
    assert len(values) > 1 and 'J of objects that move, chunk' in found.text
    for value, (low, high) in zip(values, overall['j_moving_by_chunk_interval'], strict=True):
        # chunks that too few episodes reach have no interval
        bracket = '' if low is None else f'\n[{low:.3f}, {high:.3f}]'
        assert f'{value:.3f}{bracket}' in found.text


def test_failed_episode_is_listed_with_its_reason(held, page):
    metrics = json.loads((held / 'metrics.json').read_text())
    (path, why), = metrics['failed'].items()  # fmt: skip
    assert path in page.text and why in page.text and 'Episodes that failed: 1' in page.text


def test_verdict_tells_a_model_that_obeys_from_one_that_does_not(
    make_pipeline, episodes, oracle, held, tmp_path
):
    out = scored(make_pipeline(oracle), episodes, tmp_path, name='oracle')
    both = report(out, held)
    verdicts = [a['class'] for a in both.all('p') if a.get('class', '').startswith('verdict')]
    assert verdicts == ['verdict', 'verdict doubt']
    assert 'low: margin over the first frame held not above 0' in both.text
    assert len(both.all('video')) == 6 and both.text.count('held') > 4
    assert 'B shuffled' in both.text and 'A imagined' in both.text


def test_report_is_made_again_without_the_model(held, page, tmp_path, capsys):
    path = tmp_path / 'again.html'
    assert main(['export', 'report', str(held), '--out', str(path)]) == 0
    assert str(path) in capsys.readouterr().out
    assert path.read_bytes() == (held / 'report.html').read_bytes()
    assert path.stat().st_size < 2_000_000


@pytest.mark.slow
def test_folder_of_several_checkpoints_is_one_report(make_pipeline, episodes, held, tmp_path):
    summaries = [
        evaluate(
            make_pipeline(),
            episodes[:1],
            tmp_path / label,
            label=label,
            name=f'{label} (1234)',
            zero_shot={episodes[0]: kind} if kind else {},
            show_progress=False,
        )
        for label, kind in (('second', 'object'), ('first', ''))
    ]
    scored(make_pipeline(), episodes[:1], tmp_path / 'stale', name='stale')
    write_comparison(summaries, tmp_path)
    found = report(tmp_path)
    assert len(found.all('video')) == 2 and 'stale' not in found.text
    assert found.text.index('second (1234)') < found.text.index('first (1234)')
    assert 'A · second (1234), zero-shot object' in found.text
    assert 'First frame held, zero-shot object' in found.text
    assert 'low: margin over the first frame held of too few episodes (1)' in found.text
    again = write_report([held, tmp_path], tmp_path / 'three.html')
    # the three have episode_0, one has the other two
    assert len(Page(again.read_text()).all('video')) == 3 + 1 + 1


def test_folder_without_evaluation_is_an_error(tmp_path, capsys):
    assert main(['export', 'report', str(tmp_path)]) == 1
    assert 'mtv-world evaluate CHECKPOINT' in capsys.readouterr().err
    (tmp_path / 'metrics.json').write_text('{"episodes": []}')
    with pytest.raises(ConfigError, match='overall'):
        write_report([tmp_path], tmp_path / 'x.html')
    with pytest.raises(ConfigError, match='at least one'):
        write_report([], tmp_path / 'x.html')


def test_lost_and_broken_frames_leave_a_page_that_says_so(make_pipeline, episodes, tmp_path):
    out = scored(make_pipeline(), episodes[:2], tmp_path)
    rollout_path(out, 'episode_0').unlink()
    rollout_path(out, 'episode_1').write_bytes(b'broken')
    found = report(out)
    assert not found.all('video')
    assert 'its frames were not kept' in found.text and 'cannot be read' in found.text


def test_nothing_moves(make_pipeline, make_episode, tmp_path):
    episode = make_episode(tmp_path / 'still', speed=0.0, outcome='unknown')
    found = report(scored(make_pipeline(), [episode], tmp_path / 'out'))
    assert 'By J of all objects.' in found.text and 'The only one: still (J 1.000)' in found.text
    assert 'margin over the first frame held not measured' in found.text
    assert {'horizon', 'success'}.isdisjoint(a.get('id') for a in found.all('section'))
    assert len(found.all('video')) == 1


def test_masks_are_outlined_where_they_are(held):
    kept = load_rollout(rollout_path(held, 'episode_0'))
    shown = outlined(kept, 256)
    factor = shown.real.shape[3] // kept.real.shape[3]
    assert factor == 4
    for o in range(len(kept.objects)):
        rows, columns = np.nonzero(kept.true_masks[0, o, -1])
        edge = shown.real[0, -1, factor * rows.min(), factor * (columns.min() + 2)]
        inside = shown.real[0, -1, factor * (rows.min() + 5), factor * (columns.min() + 5)]
        assert tuple(edge) == OUTLINES[o] and tuple(inside) != OUTLINES[o]
    assert shown.captions[0][0].startswith('J ')


def test_video_is_made_smaller_where_it_has_to(held):
    kept = load_rollout(rollout_path(held, 'episode_0'))
    large, small = make_clip(kept, max_bytes=10**7), make_clip(kept, max_bytes=1)
    assert len(small.video) < 0.7 * len(large.video)
    assert small.num_frames == large.num_frames == NUM_FRAMES


def marks(chart, kind):
    """Places of the marks of a kind, in the order in which they were drawn."""
    found = re.findall(rf'<g class="{kind}">.*?<use [^>]*x="([\d.]+)" y="([\d.]+)"', chart)
    return [(float(x), float(y)) for x, y in found]


def test_dots_lie_on_their_axis():
    values = (0.0, 0.25, 1.0)
    dots = [Dot(label='x', value=v, interval=(v, v), colour='c0') for v in values]
    unknown = Dot(label='x', value=float('nan'), interval=(0, 1), colour='c0')
    chart = dot_chart('t', [*dots, unknown])
    grid = [float(x) for x in re.findall(r'd="M ([\d.]+) [\d.]+ L \1 [\d.]+ "[^>]*--rule', chart)]
    places = [x for x, _ in marks(chart, 'dot')]
    assert places == pytest.approx([grid[0], grid[1], grid[4]], abs=0.02)
    assert np.allclose(np.diff(grid), np.diff(grid)[0], atol=0.02)
    assert 'not measured' in Page(chart).text


def test_line_lifts_the_pen_over_gaps():
    nan = float('nan')
    line = ChartLine(label='<J>', values=(0.0, 1.0, nan, 0.5), band=((0, 1),) * 4, colour='c0')
    chart = line_chart('t', [line], (1, 2, 3, 4), 'J')
    path = re.search(r'<title>&lt;J&gt;</title> <path d="([^"]*)"', chart)[1]
    assert [step[0] for step in re.findall(r'[ML] [\d. ]+', path)] == ['M', 'L', 'M']
    heights = [float(y) for _, y in re.findall(r'[ML] ([\d.]+) ([\d.]+)', path)]
    assert heights[0] > heights[2] > heights[1]
    assert heights[2] == pytest.approx((heights[0] + heights[1]) / 2)
    assert '<J>' in Page(chart).text and chart.count('fill-opacity') == 1


def test_points_at_one_place_are_one_mark_within_the_axes():
    ends = {'x_interval': (0.8, 1.0), 'y_interval': (0.7, 1.0), 'colour': 'c1'}
    points = [Point(label=n, title=f'<{n}>', x=1.0, y=1.0, **ends) for n in ('1', '2', '3')]
    chart = scatter_chart('t', points, 'true', 'judged')
    (x, y), = marks(chart, 'point')  # fmt: skip
    corner = re.findall(r'd="M ([\d.]+) [\d.]+ L \1 ([\d.]+) "[^>]*--rule', chart)[4]
    assert (x, y) == pytest.approx([float(value) for value in corner], abs=0.02)
    assert {'1, 2, 3', '<1>, <2>, <3>: 1.00, 1.00'} <= set(Page(chart).text.splitlines())


def test_equal_charts_are_equal_bytes():
    dots = [Dot(label='x', value=0.5, interval=(0.4, 0.6), colour='c0')]
    assert dot_chart('t', dots) == dot_chart('t', dots)


@pytest.mark.slow
def test_without_named_objects_pictures_are_what_is_compared(
    make_pipeline, make_episode, tmp_path
):
    # no word of the instruction is a thing, as with a robot of one's own
    episodes = [
        make_episode(tmp_path / name, objects=(), instruction='wave') for name in ('a', 'b', 'c')
    ]
    found = report(scored(make_pipeline(), episodes, tmp_path / 'out'))
    assert 'No object is named in any episode' in found.text
    ids = {attributes.get('id') for attributes in found.all('section')}
    assert 'pictures' in ids and not ids & {'headline', 'horizon', 'paper', 'tasks'}
    assert 'Objects by status' not in found.text and 'Not shown in every view' not in found.text
    metrics = json.loads((tmp_path / 'out' / 'metrics.json').read_text())
    psnr = metrics['pictures']['overall']
    for key in ('psnr', 'psnr_held'):
        assert f'{psnr[key]["value"]:.1f}' in found.text.splitlines()
    assert 'follows the commands: ' in found.text
    assert '|' in (tmp_path / 'out' / 'tables.md').read_text()  # of pictures
