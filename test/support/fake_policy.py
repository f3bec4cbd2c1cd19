"""A policy node whose policy goes wrong at its second answer, in the way that the task says."""

import time

import numpy as np

from mtv_world_ros.core.data_types import JointTrajectory

LATE_S = 7.5
#: the slow policy is still thinking when another plan has come, on a busy machine, too
SLOW_S = 3.0


class FakePolicy:
    """Turns the first joint by 0.01 rad a second; its answers are longer than a chunk."""

    name = 'fake'

    def __init__(self, task):
        self._task, self._num_answers = task, 0

    def reset(self, *, seed):
        self._num_answers = 0

    def act(self, observation, instruction):
        self._num_answers += 1
        times = np.linspace(0.3, 1.2, 4)
        positions = np.repeat(observation.positions[None], 4, axis=0)
        positions[:, 0] += 0.01 * times
        names = JOINTS
        if self._num_answers == 4:
            return None
        if self._num_answers == 2:
            FAULTS.get(self._task, lambda: None)()
            if self._task == 'nan':
                positions[1, 3] = np.nan
            if self._task == 'other_robot':
                names = tuple(f'panda_joint{k}' for k in range(14))
        return JointTrajectory(joint_names=names, times=times, positions=positions)


def crash():
    raise RuntimeError('a fault of the fake policy')


FAULTS = {
    'late': lambda: time.sleep(LATE_S),
    'slow': lambda: time.sleep(SLOW_S),
    'crashes': crash,
}
JOINTS = tuple(
    f'{arm}_{joint}'
    for arm in ('left', 'right')
    for joint in (*(f'joint{n}' for n in range(1, 7)), 'gripper')
)


def load(settings, robot):
    return lambda origin: FakePolicy(origin.task)
