from mtv_world_ros.cli.demo.run_demo import _speed_notes, sheet_notes

_J = {'j_object_mean': 0.8, 'j_moving': 0.5, 'j_copy_mean': 0.7, 'j_copy_moving': 0.25}


def test_the_sheet_has_a_line_of_every_view():
    views = ('low', 'high', 'left wrist')
    report = {
        'views': {view: _J | {'j_moving': 0.1 * k} for k, view in enumerate(views)},
        'success_by_chunk': [0.25, None],
        'reasons_by_chunk': ['4 of 16 foreseen motions succeed; more', "abstains: 'x' is no task"],
        'outcome': 'success',
        'latency_s': [1.5],
        'lead_s': [0.5, -2.48],
        'chunks': 2,
        'frames_received': 32,
        'frames_published': 32,
        'real_time_factor': 1.0,
    }
    notes = sheet_notes(report, views)
    assert [note.split(' moving objects: J ')[0].strip() for note in notes[:3]] == [*views]
    assert [note.split()[note.split().index('J') + 1] for note in notes[:3]] == [
        '0.000,', '0.100,', '0.200,',
    ]  # fmt: skip
    assert notes[3:6] == [
        'success after each chunk (recorded outcome: success):',
        '  1. 0.25: 4 of 16 foreseen motions succeed',
        "  2. cannot tell, because 'x' is no task",
    ]
    assert len(notes) == 6
    speed = _speed_notes(report)
    assert speed[0] == 'from a plan to the verdict on each chunk: 1.50 s'
    assert speed[1].endswith('they are about: 0.50 s before it, 2.48 s after it')
    assert len(speed) == 3
