"""Where meshes lie."""

from pathlib import Path

from mtv_world_ros.robot.mesh_pieces import find_mesh


def test_a_name_that_no_system_has_is_that_of_no_mesh(tmp_path: Path) -> None:
    (tmp_path / 'link.stl').write_bytes(bytes(84))
    urdf = tmp_path / 'robot.urdf'
    assert find_mesh('link.stl', urdf) == tmp_path / 'link.stl'
    assert find_mesh('link.' + '9' * 400 + 'stl', urdf) is None
