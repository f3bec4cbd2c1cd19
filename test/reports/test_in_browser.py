"""The report of an evaluation in a real browser: filters without a script, videos that play."""

import pytest

from mtv_world_ros.evaluation.evaluate_episodes import evaluate
from mtv_world_ros.reports.evaluation_page import write_report
from test.support.browser import Browser


@pytest.fixture(scope='module')
def browser(tmp_path_factory):
    opened = Browser(tmp_path_factory.mktemp('browser'))
    yield opened
    opened.close()


@pytest.mark.slow
def test_episodes_are_filtered_and_played(browser, make_pipeline, episodes, oracle, tmp_path):
    for name, model in (('held', None), ('oracle', oracle)):
        pipeline = make_pipeline(*([model] if model else []))
        evaluate(pipeline, episodes, tmp_path / name, name=name, show_progress=False)
    page = write_report([tmp_path / 'held', tmp_path / 'oracle'], tmp_path / 'report.html')
    browser.open(page.as_uri())
    everything = browser.shown()
    # the faster the block, the less the held frame fits: the worst one comes first
    assert [text.split(' (')[0] for text in everything] == [
        'Worst: episode_2', 'Median: episode_1', 'Best: episode_0',
    ]  # fmt: skip
    outcomes = {}
    for outcome in ('success', 'failure'):
        browser.choose('outcome', outcome)
        outcomes[outcome] = browser.shown()
        assert all(f'recorded outcome: {outcome}' in text for text in outcomes[outcome])
    assert sorted(sum(outcomes.values(), [])) == sorted(everything)
    browser.choose('outcome', 'all')
    browser.choose('better', 'A')
    assert browser.shown() == []
    browser.choose('better', 'B')
    assert browser.shown() == everything
    scores = browser.run("[...document.querySelectorAll('#score option')].map(o => o.text)")
    for view in ('all', 'low', 'high'):
        browser.choose('view', view)
        found = []
        for score in scores[1:]:
            browser.choose('score', score)
            found += browser.shown()
        assert sorted(found) == sorted(everything)
        browser.choose('score', 'all')
    # one view alone: half as high
    heights = []
    for view in ('all', 'low'):
        browser.choose('view', view)
        heights.append(browser.run("document.querySelector('video').clientHeight"))
    assert heights[1] == pytest.approx(heights[0] / 2, abs=3)
    width, seconds = browser.play()
    assert width > 300 and seconds > 0
    browser.choose('view', 'all')
    browser.keep('evaluation_report')
    assert '3 shown' in browser.run(
        "getComputedStyle(document.querySelector('.count'), '::after').content + "
        "document.querySelectorAll('.card').length + ' shown'"
    )
