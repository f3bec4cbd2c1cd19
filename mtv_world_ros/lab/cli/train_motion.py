"""`mtv-world train-motion`."""

from __future__ import annotations

import argparse
from pathlib import Path

from mtv_world_ros.cli.shared_options import add_overwrite, names
from mtv_world_ros.files import check_free


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'train-motion',
        help='train the object motion network: how objects move under commanded tools',
        description='Trains the object motion network of a checkpoint: where objects go when '
        'grippers grasp, carry, push and drop them; and how arms follow their commands. It learns '
        'from recorded episodes: masks of the first frame, commands, joint states, and where the '
        'objects went (/object_poses, else the masks). '
        "Writes OUT/object_motion; OUT may be the checkpoint's folder.",
    )
    parser.add_argument('dataset', type=Path, help='folder with episodes, searched recursively')
    parser.add_argument('--out', type=Path, required=True, metavar='DIR')
    parser.add_argument(
        '--init',
        type=names,
        default=(),
        metavar='DIR[,DIR]',
        help='start from DIR/object_motion; of several, from the mean of their '
        'weights, which says something only of networks that went on from the same one',
    )
    parser.add_argument(
        '--ensemble',
        type=names,
        default=(),
        metavar='DIR[,DIR]',
        help='also foresee with DIR/object_motion: networks that err in different places tell '
        'more together; the new one says what is shown',
    )
    parser.add_argument('--robot', default='yam_bimanual', help='YAML file or bundled name')
    parser.add_argument('--views', type=names, default='low,high', help='comma-separated')
    parser.add_argument(
        '--starts',
        type=int,
        default=6,
        metavar='N',
        help='also begin in mid-episode: at N frames of those that have masks, spread evenly',
    )
    parser.add_argument(
        '--steps', type=int, default=4000, help='0 = the mean of the weights of --init, as it is'
    )
    parser.add_argument('--batch-size', type=int, default=64)
    parser.add_argument('--learning-rate', type=float, default=2e-3)
    parser.add_argument(
        '--width',
        type=int,
        help="of the network (128, or that of --init); a wider one than --init's goes on from the "
        'same function',
    )
    parser.add_argument(
        '--hidden',
        type=int,
        help='numbers that an object remembers from step to step (48, or as --init); likewise',
    )
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument(
        '--compile',
        action='store_true',
        help='torch.compile: 1.8 times as fast; needs a C++ compiler',
    )
    parser.add_argument('--device', default='cpu', help='cpu, cuda, cuda:1')
    parser.add_argument(
        '--dtype',
        default='float32',
        help='of the products of matrices: float32, bfloat16, or auto (bfloat16 where the '
        'processor has it)',
    )
    parser.add_argument(
        '--threads', type=int, default=0, help='0 = all cores but one, of two both'
    )
    add_overwrite(parser)
    parser.set_defaults(handler=_train)


def _train(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.data.splits import select

    if not arguments.dataset.is_dir():
        select(arguments.dataset)  # says that it holds no episodes, before torch is imported
    import numpy as np

    from mtv_world_ros.assembly import robot_path
    from mtv_world_ros.data.recorded_policies import refuse_test_kinds
    from mtv_world_ros.geometry.robot.file import load_robot
    from mtv_world_ros.lab.training.object_motion.motion_training import (
        end_errors,
        mean_network,
        MotionTraining,
        read_tracks,
        train_motion,
    )
    from mtv_world_ros.lab.training.object_motion.response_fit import found_response
    from mtv_world_ros.lab.training.training_run import find_episodes
    from mtv_world_ros.model.checkpoint import OBJECT_MOTION_FOLDER
    from mtv_world_ros.model.object_motion.predictor import add_members, load_network
    from mtv_world_ros.model.runtime import check_device, choose_dtype, set_num_threads

    check_device(arguments.device)
    dtype = choose_dtype(arguments.dtype, arguments.device)
    check_free(arguments.out / OBJECT_MOTION_FOLDER, arguments.overwrite)
    given = [load_network(Path(folder) / OBJECT_MOTION_FOLDER) for folder in arguments.init]
    init = mean_network(given) if given else None
    others = [Path(folder) / OBJECT_MOTION_FOLDER for folder in arguments.ensemble]
    for folder in others:
        load_network(folder)
    set_num_threads(arguments.threads)
    robot = load_robot(robot_path(arguments.robot))
    paths = find_episodes(arguments.dataset)
    refuse_test_kinds(paths, 'training')
    response, told = found_response(paths, robot)
    print(told)
    tracks, skipped = read_tracks(paths, robot, arguments.views, arguments.starts, response)
    for path, reason in list(skipped.items())[:3]:
        print(f'left out: {path}: {reason}')
    held_out = [starts[0] for starts in tracks[::20]]
    network = train_motion(
        [track for number, starts in enumerate(tracks) if number % 20 for track in starts],
        arguments.out,
        MotionTraining(
            steps=arguments.steps,
            batch_size=arguments.batch_size,
            learning_rate=arguments.learning_rate,
            forced_share=0.0 if init else 0.35,
            seed=arguments.seed,
            compile=arguments.compile,
            device=arguments.device,
            dtype=dtype,
            width=arguments.width,
            hidden=arguments.hidden,
        ),
        init=init,
        response=response,
        overwrite=arguments.overwrite,
    )
    add_members(arguments.out / OBJECT_MOTION_FOLDER, others)
    errors, ways = end_errors(network, held_out)
    moved = ways > 0.015
    print(f'{len(tracks)} episodes, {len(skipped)} left out; {len(held_out)} held out:')
    print(
        f'objects that moved: n {moved.sum()}, median error at the end '
        f'{1e3 * np.median(errors[moved]) if moved.any() else float("nan"):.1f} mm, within 2 cm '
        f'{np.mean(errors[moved] < 0.02) if moved.any() else float("nan"):.2f}'
    )
    return 0
