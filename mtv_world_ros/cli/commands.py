"""The table of commands, read without importing them, and names that commands had before."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CommandEntry:
    """Place and purpose of a command.

    Attributes:
        module: module below `mtv_world_ros.cli` whose function `add` takes the subparsers.
        help: one line for `mtv-world --help`.
        section: heading under which `mtv-world --help` shows it.
        function: name of the function that adds it.
        is_long: whether it takes seconds to load, and says so.
    """

    module: str
    help: str
    section: str
    function: str = 'add'
    is_long: bool = True


#: headings of `mtv-world --help`, in its order
SECTIONS = ('Look', 'Run', 'Learn', 'Judge', 'Prepare')

#: command, of one word or two -> its entry, in the order of `mtv-world --help`
COMMANDS = {
    'demo': CommandEntry(
        'demo.command', 'replay the bundled episode through the ROS node and score it', 'Look'
    ),
    'replay': CommandEntry(
        'imagine', 'play an episode into ROS topics, or imagine it offline', 'Look', 'add_replay'
    ),
    'view': CommandEntry(
        'view', 'show episodes, predictions, rankings or a running node in Rerun', 'Look',
        is_long=False,
    ),
    'imagine': CommandEntry(
        'imagine', 'run a policy for whole episodes in the world model', 'Run', 'add_imagine'
    ),
    'foresee': CommandEntry(
        'foresee', 'foresee object motion under recorded commands by physics alone', 'Run'
    ),
    'train': CommandEntry('train', 'train a world model on a folder of episodes', 'Learn'),
    'fit contact': CommandEntry(
        'fits.contact', 'fit arm response, friction, weight and grip of the physics', 'Learn'
    ),
    'fit success': CommandEntry(
        'fits.success', "fit a checkpoint's success estimate to recorded outcomes", 'Learn'
    ),
    'fit camera': CommandEntry(
        'fits.camera', 'estimate camera poses from recordings in which the arm moves', 'Learn'
    ),
    'evaluate': CommandEntry('evaluate', 'score checkpoints on recorded episodes', 'Judge'),
    'rank': CommandEntry(
        'rank', 'rank policies in imagination, and compare with the simulator', 'Judge'
    ),
    'collect': CommandEntry('collect', 'record episodes of the simulated benchmark', 'Prepare'),
    'robot': CommandEntry(
        'robot', 'print and draw a robot, and make its YAML from a URDF', 'Prepare', is_long=False
    ),
    'task': CommandEntry(
        'task', 'draft the YAML of a task from an instruction', 'Prepare', is_long=False
    ),
    'check': CommandEntry(
        'check', 'check calibration, joints, clocks and images of recordings', 'Prepare'
    ),
    'import bag': CommandEntry(
        'imports.bag', "convert a robot's own rosbag2 recordings into episodes", 'Prepare'
    ),
    'import lerobot': CommandEntry(
        'imports.lerobot', 'convert a LeRobot data set (v2.0, v2.1, v3.0) into episodes', 'Prepare'
    ),
    'import videos': CommandEntry(
        'imports.videos', 'convert videos with tables of joints or tool poses into episodes',
        'Prepare',
    ),
    'import wan': CommandEntry(
        'imports.wan', 'convert public Wan 2.1 weights into a checkpoint', 'Prepare'
    ),
    'recover': CommandEntry(
        'recover', 'repair bags of recordings that were killed or cut off', 'Prepare',
        is_long=False,
    ),
    'export lerobot': CommandEntry(
        'export_lerobot', 'convert episodes into a LeRobot data set (v3.0)', 'Prepare'
    ),
    'export report': CommandEntry(
        'evaluate', 'write the HTML report of evaluations again', 'Prepare', 'add_report', False
    ),
}  # fmt: skip


#: options that left, with their command -> what to use now
REMOVED_OPTIONS = {
    'demo --robot': 'the demo takes the robot of its checkpoint',
    'demo --seed': 'the demo has the seed 0; mtv-world replay --offline --seed sets another',
    'demo --no-foresight': 'it had no effect here; mtv-world replay --offline --no-foresight has',
    'demo --no-camera-check': 'it had no effect here; mtv-world replay --offline '
    '--no-camera-check has',
    'fit success --l2': 'the prior has the strength 1',
    'imagine --start': 'mtv-world replay --offline imagines every recorded plan from the frames '
    'at its time; to begin a policy later, cut the recording there (ros2 bag convert)',
    'imagine --max-seconds': 'an episode ends after an hour; --max-chunks ends it earlier',
    'import wan --guidance-scale': 'set sampling.guidance_scale in a copy of the preset, and give '
    'the copy as --preset',
    'import wan --negative-prompt': 'set sampling.negative_prompt in a copy of the preset, and '
    'give the copy as --preset',
    'train --held-out-episodes': 'four episodes are scored during training; mtv-world evaluate '
    '--episodes scores another number of them afterwards',
}

_NO_WORTH = 'no measurement showed its worth; version 0.1.0 has it'
#: commands that left -> what to use, or why there is nothing
REMOVED = {
    'import-bag': "use 'mtv-world import bag'",
    'import-dataset': "use 'mtv-world import lerobot'",
    'import-videos': "use 'mtv-world import videos'",
    'import-weights': "use 'mtv-world import wan'",
    'export-dataset': "use 'mtv-world export lerobot'",
    'report': "use 'mtv-world export report'",
    'doctor': "use 'mtv-world check'",
    'calibrate': "use 'mtv-world fit success'",
    'fit-contact': "use 'mtv-world fit contact'",
    'calibrate-camera': "use 'mtv-world fit camera'",
    'faults': "use 'mtv-world rank --list-faults'",
    'distill': _NO_WORTH,
    'train-motion': _NO_WORTH,
}
