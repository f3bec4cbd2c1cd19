"""Fitting the success estimate, and its scores, against numbers from elsewhere."""

from dataclasses import replace
import json
from math import isnan, nan
import re

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import expit, log_expit

from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.evaluation.fit import (
    AFTER,
    AFTER_KINDS,
    AFTER_PHYSICS,
    BEFORE,
    calibrate,
    fit_futures,
    fit_logistic,
    FITTED,
    OBSERVED,
    RESUMED,
    Sample,
    UNFORESEEN,
)
from mtv_world_ros.evaluation.metrics.success_agreement import (
    agreement,
    area_under_roc,
    expected_calibration_error,
    Judgement,
)
from mtv_world_ros.reports.calibration_report import markdown, write_calibration_report
from mtv_world_ros.success.calibration import (
    CALIBRATION,
    Calibration,
    HORIZON,
    HorizonCurve,
    load_fit,
    save_fit,
)
from mtv_world_ros.success.doubts import NEAR_M
from mtv_world_ros.success.estimator import capped
from test.support.tables import table


def judgements(probabilities, outcomes):
    words = ('failure', 'success')
    return [
        Judgement(probability=p, outcome=words[o])
        for p, o in zip(probabilities, outcomes, strict=True)
    ]


def test_brier_score_is_that_of_scikit_learns_example():
    # sklearn.metrics.brier_score_loss: y_true [0, 1, 1, 0], y_prob [0.1, 0.9, 0.8, 0.3]
    found = agreement(judgements([0.1, 0.9, 0.8, 0.3], [0, 1, 1, 0]))
    assert found['brier'] == pytest.approx(0.0375)


def test_area_under_roc_is_that_of_scikit_learns_example():
    # sklearn.metrics.roc_auc_score: y [0, 0, 1, 1], scores [0.1, 0.4, 0.35, 0.8]
    assert agreement(judgements([0.1, 0.4, 0.35, 0.8], [0, 0, 1, 1]))['auroc'] == 0.75


def test_balanced_accuracy_is_that_of_scikit_learns_example():
    # sklearn.metrics.balanced_accuracy_score: y_true [0,1,0,0,1,0], y_pred [0,1,0,0,0,1]
    found = agreement(judgements([0.1, 0.9, 0.1, 0.1, 0.1, 0.9], [0, 1, 0, 0, 1, 0]))
    assert found['balanced_accuracy'] == 0.625
    assert found['false_success_rate'] == 0.25


def test_scores_are_those_of_torchmetrics():
    torch = pytest.importorskip('torch')
    functional = pytest.importorskip('torchmetrics.functional.classification')
    rng = np.random.default_rng(3)
    said = np.minimum(np.round(rng.uniform(size=200), 2) + 0.003, 0.999)
    real = rng.uniform(size=200) < said**1.5
    probability, labels = torch.tensor(said), torch.tensor(real.astype(int))
    auroc = float(functional.binary_auroc(probability, labels))
    assert area_under_roc(said, real) == pytest.approx(auroc, abs=1e-6)
    ece = float(functional.binary_calibration_error(probability, labels, n_bins=10, norm='l1'))
    assert expected_calibration_error(said, real) == pytest.approx(ece, abs=1e-5)


def test_what_abstains_counts_in_the_abstention_rate_alone():
    unknown = Judgement(probability=0.9, outcome='unknown')
    found = agreement([*judgements([0.9, nan, 0.2, nan], [1, 1, 0, 0]), unknown])
    assert (
        found['num_outcomes_known'] == 4
        and found['num_abstained'] == 2
        and found['abstention_rate'] == 0.5
    )
    assert found['accuracy'] == 1.0 and found['false_success_rate'] == 0.0
    assert all(agreement([])[name] is None for name in ('ece', 'auroc', 'accuracy'))


def test_an_open_verdict_counts_in_scores_of_estimates_but_not_of_verdicts():
    found = agreement(judgements([0.9, 0.6, 0.2, 0.7], [1, 1, 0, 0]))
    assert found['num_abstained'] == 2 and found['abstention_rate'] == 0.5
    assert found['accuracy'] == 1.0 and found['false_success_rate'] == 0.0
    assert found['estimated_success_rate'] == pytest.approx(0.6)
    assert found['brier'] == pytest.approx((0.01 + 0.16 + 0.04 + 0.49) / 4)


def test_one_outcome_alone_has_no_auroc_and_no_balanced_accuracy():
    found = agreement(judgements([0.9, 0.8], [1, 1]))
    assert found['auroc'] is None and found['balanced_accuracy'] is None


def test_logistic_is_at_the_minimum_that_torchs_optimizer_finds():
    torch = pytest.importorskip('torch')
    rng = np.random.default_rng(0)
    features = rng.normal(size=(60, 3))
    labels = features @ (1.5, -1.0, 0.0) + 0.4 + rng.logistic(size=60) > 0
    found = fit_logistic(features, labels, l2=0.7)
    theta = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    x, y = torch.tensor(features), torch.tensor(labels.astype(float))
    optimizer = torch.optim.LBFGS([theta], max_iter=200, tolerance_grad=1e-12)

    def loss():
        optimizer.zero_grad()
        logits = x @ theta[:3] + theta[3]
        value = torch.nn.functional.binary_cross_entropy_with_logits(logits, y, reduction='sum')
        value = value + 0.35 * (theta[:3] ** 2).sum()
        value.backward()
        return value

    optimizer.step(loss)
    expected = theta.detach().numpy()
    assert [*found.weights, found.bias] == pytest.approx(expected.tolist(), abs=1e-5)


def test_outcomes_that_a_plane_separates_have_finite_weights():
    features = np.array([[-1.0], [-0.5], [0.5], [1.0]])
    found = fit_logistic(features, features[:, 0] > 0, l2=1e-3)
    assert np.isfinite(found.weights).all() and found.weights[0] > 1


def test_logistic_needs_rows_and_a_penalty():
    with pytest.raises(ConfigError, match='0 episodes'):
        fit_logistic(np.zeros((0, 2)), np.zeros(0, bool))
    with pytest.raises(ConfigError, match='l2 = 0'):
        fit_logistic(np.zeros((2, 2)), np.zeros(2, bool), l2=0)


@table('seed', range(40))
def test_bounded_fit_is_at_the_minimum_that_scipys_slsqp_finds(seed):
    """Random data sets, every other one against the prior."""
    rng = np.random.default_rng(seed)
    num, count, l2 = int(rng.integers(8, 200)), int(rng.integers(1, 7)), 10 ** rng.uniform(-2, 1)
    prior = np.abs(rng.normal(size=count)) * 10 ** rng.uniform(-1, 1)
    features = rng.normal(size=(num, count))
    logits = features @ prior * (-1 if seed % 2 else 1) + rng.normal()
    signs = np.where(rng.uniform(size=num) < expit(logits), 1.0, -1.0)

    def objective(theta):
        likelihood = log_expit(signs * (features @ theta[:-1] + theta[-1])).sum()
        return l2 / 2 * ((theta[:-1] - prior) ** 2).sum() - likelihood

    bounds, other = [(0, None)] * count + [(-30, 30)], np.append(prior, 0.0)
    for _ in range(3):  # begun anew where its line search gave up
        options = {'ftol': 1e-14, 'maxiter': 1000}
        other = minimize(objective, other, method='SLSQP', bounds=bounds, options=options).x
    found = fit_logistic(features, signs > 0, l2=l2, prior=prior, non_negative=True)
    ours = np.append(found.weights, found.bias)
    assert objective(ours) <= objective(other) + 1e-9 and (found.weights >= 0).all()
    assert ours == pytest.approx(other, abs=2e-3)


def test_one_outcome_alone_has_a_finite_bias():
    found = fit_logistic(np.ones((5, 1)), np.ones(5, bool))
    assert 3 < found.bias <= 30


def made_samples(num=60, seed=0, tasks=('stack', 'serve', 'shake')):
    """Imagined episodes: the margin tells little, the grasp tells what really happened."""
    rng = np.random.default_rng(seed)
    samples = []
    for index in range(num):
        success = bool(rng.uniform() < 0.5)
        features = {
            'margin': float(rng.normal(0.5 + success)),
            'mean_margin': 1.0,
            'goal': nan if index % 3 else float(rng.normal(success, 0.5)),
            'contained': nan,
            'grasp': float(rng.normal(0.5 if success else -1.0, 0.4)),
            'carry': 0.5,
            'released': 1.0,
        }
        abstains = index % 10 == 9
        samples.append(
            Sample(
                episode=f'{index:03d}',
                task=tasks[index % len(tasks)],
                success=success,
                features=({},) if abstains else (features,),
                before=(nan if abstains else 0.9,),
                reasons=('abstains: lost',) if abstains else ('fine',),
            )
        )
    return samples


def test_calibration_tells_failures_that_the_masks_call_successes():
    found = calibrate(made_samples(), segmenter='colour')
    before, after = (found.calibration.scores[name] for name in (BEFORE, AFTER))
    assert before['false_success_rate'] == 1.0
    assert after['false_success_rate'] < 0.2
    assert after['brier'] < 0.15 < before['brier']
    assert after['auroc'] > 0.9
    assert after['num_abstained'] == before['num_abstained'] == 6
    weights = dict(zip(found.calibration.features, found.calibration.weights, strict=True))
    assert weights['grasp'] == max(weights.values())


def test_left_out_tasks_do_not_leak_into_what_judges_them():
    samples = made_samples()
    fitted = calibrate(samples, segmenter='colour')
    # another outcome in one task changes only how the others are judged
    flipped = [replace(s, success=not s.success) if s.task == 'shake' else s for s in samples]
    other = calibrate(flipped, segmenter='colour')
    same = [
        a.probability == b.probability or a.probability != a.probability
        for a, b, s in zip(fitted.judgements[AFTER], other.judgements[AFTER], samples, strict=True)
        if s.task == 'shake'
    ]
    assert all(same)
    moved = [
        abs(a.probability - b.probability)
        for a, b, s in zip(fitted.judgements[AFTER], other.judgements[AFTER], samples, strict=True)
        if s.task == 'stack' and np.isfinite(a.probability)
    ]
    assert max(moved) > 0.05
    assert fitted.judgements[FITTED] != other.judgements[FITTED]


def test_left_out_fault_kinds_do_not_leak_into_what_judges_them():
    kinds = ((), ('high',), ('late',), ('high', 'late'))
    samples = [replace(s, kinds=kinds[i // 2 % 4]) for i, s in enumerate(made_samples())]
    assert AFTER_KINDS not in calibrate(made_samples(), segmenter='colour').judgements
    fitted = calibrate(samples, segmenter='colour')
    flipped = [replace(s, success=not s.success) if 'high' in s.kinds else s for s in samples]
    other = calibrate(flipped, segmenter='colour')
    pairs = zip(fitted.judgements[AFTER_KINDS], other.judgements[AFTER_KINDS], strict=True)
    same = [a.probability == b.probability or np.isnan(a.probability) for a, b in pairs]
    # those with the kind have not seen any of it; those with another kind, or none, have
    assert all(same[i] for i, s in enumerate(samples) if 'high' in s.kinds)
    assert not all(same[i] for i, s in enumerate(samples) if s.kinds == ('late',))
    text = markdown(fitted, None)
    assert '| after: each fault kind left out of the fit |' in text
    assert '## By fault kind' in text and '| (no fault) |' in text


def with_telling_margins(samples, name):
    """Those that were judged, with other features whose margin tells what happened."""
    return [
        replace(s, **{name: {**s.features[0], 'margin': 2.0 if s.success else -2.0}})
        for s in samples
        if s.features[0]
    ]


def test_recorded_frames_are_fitted_by_themselves():
    samples = made_samples()
    assert calibrate(samples, segmenter='colour').calibration.observed is None
    seen = with_telling_margins(samples, 'observed')
    found = calibrate(seen, segmenter='colour')
    assert OBSERVED in found.judgements and found.calibration.scores[OBSERVED]['auroc'] > 0.99
    observed, imagined = found.calibration.given(True), found.calibration.given(False)
    # of what was seen, the margin tells
    per_margin = [w.weights[0] / w.scales[0] for w in (observed, imagined)]
    assert per_margin[0] > 1.2 > 0.8 > per_margin[1]
    # what is imagined is judged as before
    assert imagined.weights == calibrate(samples, segmenter='colour').calibration.weights
    text = markdown(found, None)
    assert '| the recorded frames, each kind or task left out of a fit to them |' in text
    assert '## Weights for frames that were seen' in text


def test_where_nothing_is_foreseen_what_began_in_mid_episode_is_fitted():
    samples = made_samples()
    assert calibrate(samples, segmenter='colour').calibration.unforeseen is None
    begun = with_telling_margins(samples, 'resumed')
    begun[0] = replace(begun[0], resumed={})
    found = calibrate(begun, segmenter='colour')
    assert isnan(found.judgements[UNFORESEEN][0].probability)
    assert found.calibration.scores[UNFORESEEN]['auroc'] > 0.99
    alone, usual = found.calibration.given(False), found.calibration
    assert alone.weights[0] / alone.scales[0] > 1.2 > 0.8 > usual.weights[0] / usual.scales[0]
    assert usual.weights == calibrate(samples, segmenter='colour').calibration.weights
    text = markdown(found, None)
    assert (
        '| the same with nothing foreseen, each kind or task left out of a fit to them |' in text
    )
    resumed, unforeseen = (
        [one.probability for one in found.judgements[name]] for name in (RESUMED, UNFORESEEN)
    )
    np.testing.assert_array_equal(resumed, unforeseen)
    foreseen = [replace(s, resumed={**s.resumed, 'foreseen': 0.9}) for s in begun]
    both = calibrate(foreseen, segmenter='colour')
    assert both.calibration.unforeseen == found.calibration.unforeseen
    np.testing.assert_array_equal(
        [one.probability for one in both.judgements[UNFORESEEN]],
        [one.probability for one in found.judgements[UNFORESEEN]],
    )
    told = [judged.probability for judged in both.judgements[RESUMED]]
    assert told[1] != both.judgements[UNFORESEEN][1].probability
    assert '## Weights where no motion is foreseen' in text


def test_task_that_is_all_there_is_cannot_be_left_out():
    found = calibrate(made_samples(tasks=('stack',)), segmenter='colour')
    assert found.calibration.scores[AFTER]['abstention_rate'] == 1.0
    assert found.calibration.scores[FITTED]['abstention_rate'] == pytest.approx(0.1)


def test_seeds_are_averaged_and_most_of_them_decide_whether_it_abstains():
    samples = made_samples()
    known = samples[0]
    many = [
        replace(known, episode='a', features=(*known.features, {}), before=(0.9, nan)),
        replace(known, episode='b', features=known.features * 3, before=(0.9, 0.6, nan)),
        *samples,
    ]
    found = calibrate(many, segmenter='colour')
    assert np.isnan(found.judgements[BEFORE][0].probability)
    assert found.judgements[BEFORE][1].probability == pytest.approx(0.75)
    assert found.calibration.num_seeds == 3


@pytest.mark.parametrize(
    ('samples', 'message'),
    [
        ([], '0 episodes have a known outcome'),
        ([replace(s, success=True) for s in made_samples()], 'both outcomes'),
        ([replace(s, features=({},)) for s in made_samples()], 'of which 0 could be judged'),
    ],
)
def test_episodes_that_tell_nothing_are_refused(samples, message):
    with pytest.raises(ConfigError, match=message):
        calibrate(samples, segmenter='colour')


def test_closed_gripper_is_small_whatever_was_fitted():
    samples = made_samples()
    held = replace(samples[0], features=({**samples[0].features[0], 'grasp': 3, 'released': 0.0},))
    found = calibrate([held, *samples[1:]], segmenter='colour')
    assert found.judgements[AFTER][0].probability <= 0.1


def test_what_was_left_where_it_was_is_no_success_whatever_was_fitted():
    samples = made_samples()
    features = {**samples[0].features[0], 'grasp': 1.0, 'margin': -3.0, 'moved': 0.0}
    found = calibrate(
        [replace(samples[0], features=(features,)), *samples[1:]], segmenter='colour'
    )
    assert found.judgements[AFTER][0].probability <= 0.1
    # where the relation holds without a move there is nothing to object
    assert capped(0.9, {**features, 'margin': 0.5}) == 0.9
    # nor where a rollout begins at the goal and the place is known to some millimetres
    assert capped(0.9, {**features, 'margin': -0.6}) == 0.9


def test_a_good_grasp_speaks_for_nothing():
    calibration = calibrate(made_samples(), segmenter='colour').calibration
    grasped = {'margin': 0.0, 'grasp': 1.0}
    assert calibration.probability(grasped) == calibration.probability({**grasped, 'grasp': 0.0})
    assert calibration.probability({**grasped, 'grasp': -1.0}) < calibration.probability(grasped)


def of_futures(share, success, physics='nominal', **features):
    """A sample of which a share of 16 futures succeeds."""
    features = {'margin': 0.0, 'foreseen': 2 * share - 1, 'futures': 16.0, **features}
    return Sample(
        episode=f'{physics} {share} {success}',
        task='stack',
        success=success,
        features=(features,),
        before=(share,),
        reasons=(),
        physics=physics,
    )


def test_the_fit_of_shares_is_that_of_a_logistic_on_their_log_odds():
    """Golden: scipy's own minimiser on the penalised likelihood."""
    shares = np.repeat([0.0, 0.25, 0.5, 0.75, 1.0], 20)
    real = np.tile(np.arange(20), 5) < np.repeat([1, 3, 8, 14, 19], 20)
    found = fit_futures(
        [of_futures(s, bool(r)) for s, r in zip(shares, real, strict=True)], l2=1.0
    )
    odds = np.log((16 * shares + 1) / (16 * (1 - shares) + 1))

    def loss(theta):
        logits = theta[0] + theta[1] * odds
        away = (theta[1] - 1) * odds.std()
        return -log_expit(np.where(real, logits, -logits)).sum() + away**2 / 2

    expected = minimize(loss, [0.0, 1.0], method='Nelder-Mead', options={'xatol': 1e-7}).x
    assert [found.bias, found.slope] == pytest.approx(expected, abs=1e-4)
    assert found.num_episodes == 100
    # the curvature of that loss, by differences
    h, points = 1e-4, [np.array(p) for p in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    cross = sum(loss(expected + h * p) * p.prod() for p in points) / (4 * h**2)
    both = [
        (loss(expected + h * e) - 2 * loss(expected) + loss(expected - h * e)) / h**2
        for e in np.eye(2)
    ]
    covariance = np.linalg.inv([[both[0], cross], [cross, both[1]]])
    wanted = [covariance[0, 0], covariance[0, 1], covariance[1, 1]]
    assert found.covariance == pytest.approx(wanted, rel=1e-2)


def test_several_seeds_of_an_episode_are_no_more_episodes():
    shares = np.repeat([0.0, 0.25, 0.5, 0.75, 1.0], 4)
    samples = [of_futures(share, k % 4 < 4 * share) for k, share in enumerate(shares)]
    seeds = [replace(sample, features=sample.features * 3) for sample in samples]
    once, thrice = fit_futures(samples, 1.0), fit_futures(seeds, 1.0)
    assert thrice.num_episodes == len(samples)
    assert thrice.covariance == pytest.approx(once.covariance)
    assert [thrice.bias, thrice.slope] == pytest.approx([once.bias, once.slope])
    assert fit_futures(seeds[:4], 1.0) is None


def test_frames_that_follow_the_motion_state_the_limit_of_a_contradiction():
    gaps = np.linspace(0.0, 0.1, 41)
    samples = [of_futures(k % 2, bool(k % 2), picture_gap=gap) for k, gap in enumerate(gaps)]
    assert fit_futures(samples, 1.0).max_picture_gap_m == pytest.approx(0.0975)
    near = [of_futures(k % 2, bool(k % 2), picture_gap=0.01) for k in range(10)]
    assert fit_futures(near, 1.0).max_picture_gap_m == NEAR_M
    assert fit_futures(samples[:6], 1.0) is None


def test_each_physics_is_judged_by_a_fit_without_it():
    """In one physics futures are right, in the other they say nothing."""
    good = [of_futures(k % 2, bool(k % 2)) for k in range(40)]
    poor = [of_futures(k % 2, bool(k % 4 < 2), 'bold') for k in range(40)]
    found = calibrate([*good, *poor], segmenter='colour')
    sure = [one.probability for one in found.judgements[AFTER_PHYSICS]]
    # what judges `bold` was fitted in nominal, and is sure; what judges nominal is not
    assert max(sure[40:]) > 0.95 and max(sure[:40]) < 0.8
    text = markdown(found, None)
    assert '| after: each physics left out of the fit |' in text
    assert '## Where object motion is simulated' in text


def test_frames_do_not_change_an_estimate_of_futures():
    """The frames show the motion that was drawn: they are no second witness."""
    rng = np.random.default_rng(0)
    samples = [
        of_futures(k % 2, bool(k % 2), margin=float(rng.normal(3 * (k % 2), 0.1)))
        for k in range(40)
    ]
    said = calibrate(samples, segmenter='colour')
    blank = [replace(s, features=({**s.features[0], 'margin': -3.0},)) for s in samples]
    assert calibrate(blank, segmenter='colour').judgements[FITTED] == said.judgements[FITTED]


def test_weights_stay_as_stated_where_the_episodes_say_nothing():
    rng = np.random.default_rng(0)
    rows = np.stack([rng.normal(size=50), np.zeros(50)], axis=1)
    prior = np.array([0.3, 2.0])
    found = fit_logistic(rows, rows[:, 0] > 0, l2=1.0, prior=prior)
    assert found.weights[1] == pytest.approx(2.0) and found.weights[0] > 1
    strong = fit_logistic(rows, rows[:, 0] > 0, l2=1e6, prior=prior)
    assert strong.weights == pytest.approx(prior, abs=1e-3)


def test_calibration_is_read_back_as_it_was_stored(tmp_path):
    calibration = calibrate(made_samples(), segmenter='colour', made={'date': 'today'}).calibration
    save_fit(tmp_path, calibration)
    read = load_fit(tmp_path, Calibration)
    assert read is not None
    assert read.weights == calibration.weights and read.tasks == calibration.tasks
    features = {'margin': 1.0, 'grasp': nan}
    assert read.probability(features) == calibration.probability(features)
    assert load_fit(tmp_path / 'none', Calibration) is None


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'weights': [1.0]}, 'not equally many'),
        ({'bias': None}, 'cannot be used'),
        ({'wieghts': []}, "unknown key 'wieghts'"),
        ({'scales': [0.0] * 6}, 'scale is not positive'),
    ],
)
def test_broken_calibration_says_what_to_do(tmp_path, change, message):
    save_fit(tmp_path, calibrate(made_samples(), segmenter='colour').calibration)
    file = tmp_path / CALIBRATION
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    with pytest.raises(CheckpointError, match=message) as caught:
        load_fit(tmp_path, Calibration)
    assert 'mtv-world fit success' in str(caught.value)


def test_calibration_does_not_hold_for_another_segmenter_or_task():
    calibration = calibrate(made_samples(), segmenter='colour').calibration
    assert calibration.objection('stack', 'colour') == ''
    assert "segmenter 'colour', not with 'sam2'" in calibration.objection('stack', 'sam2')
    assert "tasks without 'pour'" in calibration.objection('pour', 'colour')


CURVE = HorizonCurve(
    period_s=0.2, values=(0.95, 0.9, 0.8, 0.85), lower=(0.9, 0.8, 0.6, 0.7), segmenter='colour',
    num_episodes=3,
)  # fmt: skip


@pytest.mark.parametrize(
    ('level', 'seconds'), [(0.95, 0.0), (0.85, 0.2), (0.8, 0.4), (0.65, 0.4), (0.5, 0.8)]
)
def test_trusted_up_to_the_first_frame_whose_lower_bound_falls_below_the_level(level, seconds):
    assert CURVE.trusted_seconds(level) == pytest.approx(seconds)


def test_horizon_is_read_back_and_a_broken_one_is_refused(tmp_path):
    save_fit(tmp_path, CURVE)
    assert load_fit(tmp_path, HorizonCurve) == CURVE
    (tmp_path / HORIZON).write_text('{"period_s": 0}')
    with pytest.raises(CheckpointError, match='delete the file'):
        load_fit(tmp_path, HorizonCurve)
    assert load_fit(tmp_path / 'none', HorizonCurve) is None


def test_report_holds_the_scores_and_a_page_that_needs_no_other_file(tmp_path):
    found = calibrate(made_samples(), segmenter='colour')
    text = write_calibration_report(tmp_path, found, CURVE)
    assert text == markdown(found, CURVE) == (tmp_path / 'calibration.md').read_text()
    row = next(line for line in text.splitlines() if line.startswith('| before'))
    assert row.endswith('| 1.000 |')  # false-success rate of "0.9 always"
    assert '| 0.8 | 0.4 s |' in text
    page = (tmp_path / 'reliability.html').read_text()
    assert page.count('<svg') == 2 and 'http' not in page.replace('http-equiv', '')
    for variable in re.findall(r'(?:stroke|fill): var\((--\w+)\)', page):
        assert f' {variable}: #' in page  # or it is drawn in no colour
    assert 'stroke: var(--c0)' in page
    values = json.loads((tmp_path / 'calibration.json').read_text())
    assert len(values['samples']) == 60 and values['samples'][9]['after'] is None
