"""Features, columns, keys and files that no episode has are named once, with why."""

import json

from mtv_world_ros.cli import main


def test_features_and_columns_of_a_data_set(datasets, make_mapping, tmp_path, capsys):
    mapping = make_mapping()
    out = tmp_path / 'out'
    command = ['import', 'lerobot', str(datasets('v3.0')), '--mapping', str(mapping)]
    assert main([*command, '--out', str(out)]) == 0
    said = capsys.readouterr().err
    lines = [line for line in said.splitlines() if 'not used' in line]
    assert len(lines) == 1, said
    assert 'force of observation.state' in lines[0] and 'no joint of the mapping' in lines[0]


def test_keys_columns_and_files_of_recordings(tmp_path, capsys):
    import numpy as np

    from mtv_world_ros.robot.file import load_robot, robot_path
    from test.importing.test_import_videos import mapping, write_raw

    robot, raw = load_robot(robot_path('franka')), tmp_path / 'raw'
    rest = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.8, 0.04])
    positions = rest + np.linspace(0, 0.2, 12)[:, None] * [1, 0, 0, 0, 0, 0, 0, 0]
    for name in ('a', 'b'):
        write_raw(raw, name, positions, effort=[[1.0]] * 12)
    (raw / 'videos' / 'a' / 'wrist.mp4').write_bytes(b'')
    (raw / 'videos' / 'c').mkdir()
    (raw / 'videos' / 'c' / 'front.mp4').write_bytes(b'')
    file = tmp_path / 'mapping.yaml'
    mapping(file, robot, list(range(7)), 7)
    command = ['import', 'videos', str(raw), '--mapping', str(file)]
    assert main([*command, '--out', str(raw / 'out')]) == 0
    said = capsys.readouterr().err
    lines = [line for line in said.splitlines() if 'not used' in line]
    assert len(lines) == 2, said
    assert 'a, b: not used: ' in lines[0] and 'effort' in lines[0]
    assert 'no key of the mapping names it' in lines[0]
    assert lines[1].startswith('not used: videos/a/wrist.mp4, videos/c/front.mp4 (no recording')
    assert json.dumps(lines).count('wrist.mp4') == 1
