"""What counts as a valid list of objects, whoever wrote it."""

from __future__ import annotations

import json

import pytest

from mtv_world_ros.core.errors import DescriptionError
from mtv_world_ros.vision.describers.describer import check_objects, DescribedObject, names_of

CUP = {
    'id': 'cup',
    'name': 'blue cup',
    'colour': 'blue',
    'category': 'cup',
    'role': 'container',
    'box': [0, 10, 1000, 20],
}


def test_a_full_object_is_taken_as_it_is():
    (found,) = check_objects([CUP], complete=True)
    assert found == DescribedObject(**{**CUP, 'box': (0.0, 10.0, 1000.0, 20.0)})


def test_box_and_colour_may_be_unknown():
    (found,) = check_objects([{**CUP, 'box': None, 'colour': None}], complete=True)
    assert (found.box, found.colour) == (None, None)


def test_an_empty_list_is_valid():
    assert check_objects([], complete=True) == ()


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'role': 'tool'}, "'role' is 'tool'; expected one of manipuland, support, container"),
        ({'role': None}, "'role' is None"),
        ({'name': 'the small blue cup over there'}, '1 to 5 words'),
        ({'name': ' '}, '1 to 5 words'),
        ({'name': 'blue\ncup'}, '1 to 5 words'),
        ({'name': 7}, "'name' is 7"),
        ({'id': 'blue cup'}, 'letters, digits'),
        ({'id': None}, "'id' is None"),
        ({'category': ''}, "'category'"),
        ({'colour': ['blue']}, "'colour'"),
        ({'box': [0, 0, 10]}, "'box'"),
        ({'box': [10, 0, 5, 10]}, 'left < right'),
        ({'box': [0, 10, 5, 10]}, 'top < bottom'),
        ({'box': [0, 0, 5, 1001]}, 'within 0 ... 1000'),
        ({'box': [-1, 0, 5, 10]}, 'within 0 ... 1000'),
        ({'box': [0, 0, 5, float('nan')]}, 'within 0 ... 1000'),
        ({'box': [0, 0, 5, True]}, 'within 0 ... 1000'),
        ({'box': ['0', '0', '5', '5']}, 'within 0 ... 1000'),
        ({'color': 'blue'}, "unknown key 'color' (did you mean 'colour'?)"),
    ],
)
def test_what_is_wrong_is_said(change, words):
    with pytest.raises(DescriptionError) as caught:
        check_objects([{**CUP, **change}], complete=True)
    assert words in str(caught.value)
    assert str(caught.value).startswith('objects[0]: ')
    assert caught.value.status == 'invalid'


@pytest.mark.parametrize('key', CUP)
def test_every_key_has_to_be_there(key):
    lacking = {name: value for name, value in CUP.items() if name != key}
    with pytest.raises(DescriptionError, match=f"'{key}' is missing"):
        check_objects([lacking], complete=True)


@pytest.mark.parametrize('items', [None, {}, 'red block', 3])
def test_anything_but_a_list_is_refused(items):
    with pytest.raises(DescriptionError, match='has to be a list'):
        check_objects(items, complete=True)


@pytest.mark.parametrize('item', [None, [], 'red block', 3])
def test_anything_but_a_mapping_is_no_object(item):
    with pytest.raises(DescriptionError, match=r'objects\[0\]: expected keys and values'):
        check_objects([item], complete=True)


def test_all_problems_are_told_at_once():
    with pytest.raises(DescriptionError) as caught:
        check_objects([{**CUP, 'role': 'x'}, {**CUP, 'box': 1, 'name': ''}], complete=True)
    for words in ("objects[0]: 'role'", "objects[1]: 'name'", "objects[1]: 'box'"):
        assert words in str(caught.value)


def test_two_objects_of_one_name_or_id_cannot_be_told_apart():
    twin = {**CUP, 'name': 'Blue Cup'}
    with pytest.raises(DescriptionError) as caught:
        check_objects([CUP, twin], complete=True)
    assert "name 'blue cup' is given to more than one object" in str(caught.value)
    assert "id 'cup' is given to more than one object" in str(caught.value)


def test_a_runaway_list_is_refused():
    many = [{**CUP, 'id': f'cup_{i}', 'name': f'cup {i}'} for i in range(41)]
    assert len(check_objects(many[:40], complete=True)) == 40
    with pytest.raises(DescriptionError, match='41 objects; at most 40'):
        check_objects(many, complete=True)


def test_a_person_may_give_names_alone():
    found = check_objects(['red block', {'name': 'blue  cup', 'role': None}], complete=False)
    assert names_of(found) == ('red block', 'blue cup')
    assert [item.id for item in found] == ['object_1', 'object_2']
    with pytest.raises(DescriptionError, match="'role' is 'tool'"):
        check_objects([{'name': 'cup', 'role': 'tool'}], complete=False)


def test_long_values_are_not_repeated_whole():
    with pytest.raises(DescriptionError) as caught:
        check_objects([{**CUP, 'name': json.dumps('x ' * 5000)}], complete=True)
    assert len(str(caught.value)) < 250
