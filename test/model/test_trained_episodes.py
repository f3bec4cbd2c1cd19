"""A checkpoint knows the episodes that it was trained on, or says that it does not."""

from mtv_world_ros.model.trained_episodes import TrainedEpisodes

KNOWN = TrainedEpisodes(frozenset('ab'), True)


def test_what_was_trained_on_is_counted():
    assert KNOWN.sentence(['a', 'b', 'c']) == 'trained on 2 of these 3'
    assert KNOWN.sentence(['c']) == 'trained on none of these 1'


def test_the_card_holds_it():
    assert TrainedEpisodes.of_card(KNOWN.as_card()) == KNOWN


def test_cards_of_earlier_versions_do_not_say_that_none_was_seen():
    found = TrainedEpisodes.of_card({'episodes': 3, 'steps': 2})
    assert found.holds('a') is None
    assert found.sentence(['a', 'b']).startswith('not known whether')


def test_weights_that_do_not_name_theirs_leave_it_open():
    found = KNOWN | TrainedEpisodes()
    assert found.holds('a') is True and found.holds('c') is None
    assert found.sentence(['a', 'c']) == (
        'trained on 1 of these 2; the weights that it began with do not name theirs'
    )


def test_episodes_without_a_digest_leave_it_open():
    assert KNOWN.sentence(['']).startswith('not known whether')
    assert 'earlier version' in KNOWN.sentence(['', 'c'])
