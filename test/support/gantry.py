"""Gantry arms whose joints are the tool's x, y, z, seen by a camera at the base's origin."""

import numpy as np
import pinocchio as pin
import pytest

from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.robot.model import RobotModel, Tool


def gantry(num_arms: int) -> RobotModel:
    model, names, tools = pin.Model(), [], []
    model.addFrame(pin.Frame('base', 0, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    wide, here = np.array([50.0]), pin.SE3.Identity()
    for arm in range(num_arms):
        parent = 0
        for axis, kind in (
            ('x', pin.JointModelPX()), ('y', pin.JointModelPY()), ('z', pin.JointModelPZ()),
            ('grip', pin.JointModelPX()),
        ):  # fmt: skip
            name = f'{axis}{arm}'
            carrier = parent
            parent = model.addJoint(parent, kind, here, name, wide, wide, -wide, wide)
            names.append(name)
        # the hand is carried by z, not by the gripper's own slide
        model.addFrame(pin.Frame(f'hand{arm}', carrier, 0, here, pin.FrameType.BODY))
        tools.append(
            Tool(arm=str(arm), link=f'hand{arm}', T_link_tool=np.eye(4),
                 gripper_joint=f'grip{arm}', gripper_closed=0.0, gripper_open=1.0)
        )  # fmt: skip
    return RobotModel(name='gantry', model=model, joint_names=names, tools=tools, base_link='base')


@pytest.fixture(scope='session')
def one_arm() -> RobotModel:
    return gantry(1)


@pytest.fixture(scope='session')
def two_arms() -> RobotModel:
    return gantry(2)


@pytest.fixture
def make_camera():
    def make(width=96, height=72, **changes) -> CameraModel:
        K = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1.0]])
        values = {
            'view': 'front', 'width': width, 'height': height, 'K': K, 'mount_link': 'base',
            'T_mount_camera': np.eye(4),
        }  # fmt: skip
        return CameraModel(**(values | changes))

    return make
