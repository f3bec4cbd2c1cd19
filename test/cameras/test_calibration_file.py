import numpy as np
import pytest
import yaml

from mtv_world_ros.cameras.calibration_file import load_calibration, save_calibration
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.errors import CalibrationError

ROW = {
    'width': 384,
    'height': 288,
    'K': [400.0, 401.0, 191.5, 143.5],
    'mount_link': 'base',
    'position': [0.1, 0.2, 0.3],
    'quaternion_xyzw': [0.0, 0.0, 2.0, 2.0],
}


def write(folder, row):
    path = folder / 'calibration.yaml'
    path.write_text(yaml.safe_dump({'views': {'low': row}}))
    return path


def test_cameras_come_back_to_the_last_bit(tmp_path):
    generator = np.random.default_rng(0)
    angle = 0.123456789
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:3, 3] = generator.normal(size=3) / 3
    cameras = {
        view: CameraModel(
            view=view, width=384, height=288, mount_link=link, T_mount_camera=T,
            K=np.array([[400 / 3, 0, 191.5], [0, 400 / 7, 143.5], [0, 0, 1]]),
            distortion_model=model, distortion=generator.normal(size=count), error_px=error,
        )
        for view, link, model, count, error in (
            ('low', 'base', 'plumb_bob', 5, 2 / 3),
            ('wrist', 'left_link_6', 'rational_polynomial', 8, None),
            ('high', 'base', 'none', 0, 0.9),
        )
    }  # fmt: skip
    path = tmp_path / 'calibration.yaml'
    save_calibration(path, cameras)
    loaded = load_calibration(path)
    assert list(loaded) == ['low', 'wrist', 'high']
    for view, camera in cameras.items():
        for field in ('K', 'distortion', 'T_mount_camera'):
            np.testing.assert_array_equal(getattr(loaded[view], field), getattr(camera, field))
        for field in ('view', 'width', 'height', 'distortion_model', 'mount_link', 'error_px'):
            assert getattr(loaded[view], field) == getattr(camera, field)
    assert [file.name for file in tmp_path.iterdir()] == ['calibration.yaml']


def test_position_quaternion_and_four_intrinsics_are_accepted(tmp_path):
    camera = load_calibration(write(tmp_path, ROW))['low']
    np.testing.assert_array_equal(camera.K, [[400, 0, 191.5], [0, 401, 143.5], [0, 0, 1]])
    expected = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    np.testing.assert_allclose(camera.T_mount_camera, expected, atol=1e-12)


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'widht': 1}, "view 'low': unknown key 'widht'.*did you mean 'width'"),
        ({'mount_link': None}, "'mount_link' is missing"),
        ({'K': [1, 2, 3]}, "view 'low': K is"),
        ({'K': [0, 0, 1, 1]}, "view 'low'.*not calibrated"),
        ({'K': 'auto'}, "view 'low'"),
        ({'width': 'wide'}, "view 'low'.*wide"),
        ({'error_px': -1}, "view 'low'.*error_px"),
        ({'error_px': 'small'}, "view 'low'.*error_px"),
        ({'position': None}, "either 'T_mount_camera', or 'position' and"),
        ({'T_mount_camera': np.eye(4).tolist()}, "either 'T_mount_camera', or"),
        ({'quaternion_xyzw': [0, 0, 0, 0]}, 'no quaternion'),
        ({'distortion_model': 'fisheye'}, "'fisheye'; known are"),
    ],
)
def test_wrong_values_name_file_view_and_key(tmp_path, changes, message):
    row = {key: value for key, value in (ROW | changes).items() if value is not None}
    with pytest.raises(CalibrationError, match=message):
        load_calibration(write(tmp_path, row))


def test_a_pose_that_mirrors_is_refused(tmp_path):
    row = {key: value for key, value in ROW.items() if key not in ('position', 'quaternion_xyzw')}
    row['T_mount_camera'] = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
    with pytest.raises(CalibrationError, match='must be a rigid pose'):
        load_calibration(write(tmp_path, row))


def test_other_files_are_refused(tmp_path):
    path = tmp_path / 'calibration.yaml'
    with pytest.raises(CalibrationError, match="does not exist; set 'calibration_file'"):
        load_calibration(path)
    path.write_text('views: [')
    with pytest.raises(CalibrationError, match='not valid YAML'):
        load_calibration(path)
    path.write_text('low: {}')
    with pytest.raises(CalibrationError, match="must hold 'views"):
        load_calibration(path)
