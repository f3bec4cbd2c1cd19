"""The composition root: a checkpoint and config files become a pipeline."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TYPE_CHECKING

from mtv_world_ros.control.control import Control, ControlOptions
from mtv_world_ros.control.registry import create_control, load_control
from mtv_world_ros.core.entry_points import policy_kind
from mtv_world_ros.core.errors import (
    CalibrationError,
    CheckpointError,
    ConfigError,
    nearest,
    PolicyError,
)
from mtv_world_ros.core.files import bundled, content_digest, ROBOT_YAML, share_path
from mtv_world_ros.core.processes import threads_each
from mtv_world_ros.model.card import CAMERAS, CheckpointCard, read_card, ROBOT_FOLDER
from mtv_world_ros.physics.object_motion import ObjectMotionModel
from mtv_world_ros.policies.policy import (
    EpisodeOrigin,
    load_policy_config,
    Policy,
    PolicyConfig,
    RecordedPolicy,
    RecordedPolicySettings,
    ScriptedPolicySettings,
)
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.rollout.pipeline import Pipeline, WorldModel
from mtv_world_ros.success.calibration import (
    Calibration,
    HorizonCurve,
    load_fits,
)
from mtv_world_ros.success.doubts import Grounds
from mtv_world_ros.success.estimator import SuccessEstimator
from mtv_world_ros.success.fitted_to import Setting
from mtv_world_ros.success.task import load_task, load_tasks, TaskSpec
from mtv_world_ros.vision.camera_check import CameraChecker
from mtv_world_ros.vision.describers.describer import Describer, InstructionDescriber
from mtv_world_ros.vision.segmenters.choose import choose_segmenter
from mtv_world_ros.vision.segmenters.segmenter import Segmenter

if TYPE_CHECKING:
    from mtv_world_ros.vision.describers.describer_config import DescriberConfig

BUNDLED = 'bundled'
#: folders of `resource` with the checkpoints that ship with the package, by name; the second one
#: was trained the paper's way: trails and first masks, no object motion
BUNDLED_FOLDERS = {BUNDLED: 'checkpoint', 'bundled-paper': 'checkpoint_paper'}
_YAML = ('.yaml', '.yml')
#: makes a policy for an episode's origin; most do not look at it
PolicyMaker = Callable[[EpisodeOrigin], Policy]


def checkpoint_path(name: str | Path) -> Path:
    """Returns the folder of a checkpoint, given by path or by a name of `BUNDLED_FOLDERS`.

    Raises:
        CheckpointError: no folder, and nearly the name of one that ships with the package.
    """
    folder = BUNDLED_FOLDERS.get(str(name))
    if folder is not None:
        return share_path('resource', folder)
    path = Path(name)
    if not path.exists() and path.name.replace('_', '-').startswith(BUNDLED):
        raise CheckpointError(
            f"checkpoint '{name}' is no folder and no checkpoint of the package"
            f'{nearest(str(name), BUNDLED_FOLDERS)}; those are {", ".join(BUNDLED_FOLDERS)}'
        )
    return path


def robot_path(name: str | Path) -> Path:
    """Returns the YAML of a robot given by path or by the name of a bundled one.

    Raises:
        ConfigError: no such file, and no bundled robot of this name.
    """
    path = bundled('robots', name, 'robot_file')
    if not path.is_file():
        problem = 'is no regular file' if path.exists() else 'does not exist'
        raise ConfigError(f"robot file '{path}' {problem}; set 'robot_file' to one")
    return path


def load_pipeline(
    checkpoint: str | Path = BUNDLED,
    *,
    robot: str | Path | None = None,
    objects: tuple[str, ...] = (),
    task: str | None = None,
    device: str = 'cpu',
    dtype: str = 'auto',
    num_threads: int = 0,
    segmenter: str = 'auto',
    describer: str | Path | None = None,
    serving: str = '',
    calibrated: bool = True,
    adapter: Path | None = None,
    foresight: bool = True,
    camera_check: bool = True,
) -> Pipeline:
    """Loads a checkpoint and puts the main path together around it.

    Args:
        checkpoint: folder, or `bundled`.
        robot: YAML file or name of a bundled robot; default: the one in the checkpoint.
        objects: names of the objects; empty = the describer's.
        task: the task to judge, by name or YAML file; default: the one the instruction matches.
        device: `cpu`, `cuda`, ...
        dtype: `float32`, `bfloat16`, or `auto` (bfloat16 where the processor has it).
        num_threads: threads of the model on a CPU; 0 = all cores but one, of two both. As many
            processes, or one a core, compute motions of rigid bodies.
        segmenter: `auto`, `colour`, `sam2` or `sam3`; see `choose_segmenter`.
        describer: YAML file of what names the objects of the first real frame; empty = the
            words of the instruction.
        serving: what makes the model faster or smaller, e.g. `compile=true`; see
            `ServingOptions`.
        calibrated: use the checkpoint's calibration of the success estimate, where it has one, and
            abstain where an estimate rests on nothing; False = the bare estimate.
        adapter: LoRA adapter to use in place of the checkpoint's own.
        foresight: foresee where objects go, where the checkpoint can; False = the imagined frames
            alone decide, see `Pipeline.without_foresight`.
        camera_check: compare the first pictures of an episode with the arm's outline, correct
            small errors of the calibration and refuse a verdict on large ones.

    Raises:
        CheckpointError, ConfigError, RobotError: see their messages.
    """
    from mtv_world_ros.model.checkpoint import load_checkpoint
    from mtv_world_ros.model.runtime import check_device, choose_dtype, set_num_threads
    from mtv_world_ros.model.serving import ServingOptions
    from mtv_world_ros.model.world_model import DiffusionWorldModel
    from mtv_world_ros.physics.checkpoint_files import load_foresight

    options = ServingOptions.parse(serving)
    check_device(device)
    set_num_threads(num_threads)
    number_format = choose_dtype(dtype, device)
    loaded = load_checkpoint(checkpoint_path(checkpoint), dtype=number_format)
    if adapter is not None:
        loaded = replace(loaded, adapter=adapter)
    model = checkpoint_robot(checkpoint, robot)
    folder, motion = checkpoint_path(checkpoint), None
    control = load_control(loaded.card.control, control_options(loaded.card, model), folder)
    _check_inputs(loaded.card.control, control, loaded.transformer.config)
    foresees = control.shows_objects and loaded.object_motion is not None
    if foresight and foresees and loaded.object_motion is not None:
        motion = load_foresight(loaded.object_motion, model, num_threads or threads_each(1))
    fits = load_fits(folder, of_pictures=foresees and not foresight)
    world_model = DiffusionWorldModel(
        loaded,
        device=device,
        dtype=number_format,
        serving=options,
    )
    calibration = fits.calibration if calibrated else None
    pipeline = assemble(
        loaded.card,
        world_model,
        robot=model,
        control=control,
        objects=objects,
        task=task,
        segmenter=choose_segmenter(segmenter, device=device),
        describer=asked_describer(describer),
        calibration=calibration,
        horizon=fits.horizon,
        object_motion=motion,
        camera_checker=CameraChecker(model, load_shape(model)) if camera_check else None,
        setting=fitting_setting(checkpoint, model),
    )
    if not calibrated:  # to be fitted, or compared: the bare estimate
        return pipeline
    doubt = motion.settings.doubt if motion else ''
    return replace(
        pipeline,
        grounds=Grounds.of(doubt, calibration is not None),
        picture_fits=load_fits(folder, of_pictures=True) if motion else None,
    )


def _check_inputs(name: str, control: Control, transformer: Mapping[str, Any]) -> None:
    """Raises if the transformer was not built for the inputs that a control feeds."""
    wanted = control.layout.transformer_arguments()
    for kind in ('context', 'frame'):
        key = f'{kind}_input'
        given, held = wanted.get(key), transformer.get(key)
        if given != (None if held is None else dict(held)):
            fed = f"feeds '{kind}' of {given}" if given else f"does not feed '{kind}'"
            taken = f'takes {dict(held)}' if held else 'takes none'
            raise CheckpointError(
                f"control '{name}' {fed}, the checkpoint's transformer {taken}; the control that "
                'it was trained with stands in world_model.json, as `control`'
            )


def control_options(card: CheckpointCard, robot: RobotModel) -> ControlOptions:
    """Return what the control of a checkpoint is created for."""
    return ControlOptions(
        robot=robot,
        rendering=card.rendering,
        object_mask=card.object_mask,
        num_frames=card.num_frames,
    )


def can_foresee(checkpoint: str | Path, robot: str | Path | None = None) -> bool:
    """Return whether a checkpoint foresees object motion and was trained to see it.

    Args:
        checkpoint: folder, or `bundled`.
        robot: as in `checkpoint_robot`.
    """
    from mtv_world_ros.model.checkpoint import OBJECT_MOTION_FOLDER

    folder = checkpoint_path(checkpoint)
    if not (folder / OBJECT_MOTION_FOLDER).is_dir():
        return False
    card = read_card(folder)
    options = control_options(card, checkpoint_robot(checkpoint, robot))
    return load_control(card.control, options, folder).shows_objects


def fitting_setting(checkpoint: str | Path, robot: RobotModel) -> Setting:
    """Returns what a checkpoint's calibration is fitted to, without cameras: robot, foresight."""
    from mtv_world_ros.model.checkpoint import OBJECT_MOTION_FOLDER

    folder = checkpoint_path(checkpoint) / OBJECT_MOTION_FOLDER
    return Setting.of(robot, content_digest(folder)[:16] if folder.is_dir() else '')


def assemble(
    card: CheckpointCard,
    world_model: WorldModel,
    *,
    robot: RobotModel,
    control: Control | None = None,
    objects: tuple[str, ...] = (),
    task: str | None = None,
    segmenter: Segmenter | None = None,
    describer: Describer | None = None,
    calibration: Calibration | None = None,
    horizon: HorizonCurve | None = None,
    object_motion: ObjectMotionModel | None = None,
    camera_checker: CameraChecker | None = None,
    setting: Setting | None = None,
) -> Pipeline:
    """Puts the main path around a world model trained as the card says.

    The control is that of the card; one that is fitted to a training set has to be given.
    """
    segmenter = segmenter or choose_segmenter()
    if control is None:
        control = create_control(card.control, control_options(card, robot))
    return Pipeline(
        robot=robot,
        world_model=world_model,
        segmenter=segmenter,
        estimator=SuccessEstimator(
            *_tasks(task),
            calibration=calibration,
            segmenter=segmenter,
            setting=setting,
        ),
        control=control,
        objects=objects,
        describer=describer,
        horizon=horizon,
        object_motion=object_motion,
        camera_checker=camera_checker,
    )


def _tasks(task: str | None) -> tuple[tuple[TaskSpec, ...], str | None]:
    """The known tasks, and the name of the one to judge; a file of the user's own is one more."""
    known = load_tasks(share_path('config', 'tasks'))
    if task is None or not task.endswith(_YAML):
        return known, task
    given = load_task(Path(task))
    return (*(spec for spec in known if spec.name != given.name), given), given.name


def checkpoint_robot(checkpoint: str | Path, robot: str | Path | None = None) -> RobotModel:
    """Returns the robot that a checkpoint carries or, older ones, names.

    Args:
        checkpoint: folder, or `bundled`.
        robot: another file of the same robot, or the name of a bundled one.

    Raises:
        CheckpointError: the file describes a robot of another name.
        ConfigError: there is no file of the robot.
    """
    folder = checkpoint_path(checkpoint)
    trained = read_card(folder).robot
    carried = folder / ROBOT_FOLDER / ROBOT_YAML
    default = carried if carried.is_file() else trained
    model = load_robot(robot_path(robot or default))
    # older cards name the file of a robot that is not bundled
    if model.name != trained and Path(trained).suffix not in _YAML:
        raise CheckpointError(
            f"the checkpoint was trained with robot '{trained}', 'robot_file' describes "
            f"'{model.name}'; use the trained one or train on this robot's episodes"
        )
    return model


def checkpoint_cameras(checkpoint: str | Path) -> Path:
    """Returns the default calibration that a checkpoint carries or, older ones, the robot's.

    Raises:
        CalibrationError: neither the checkpoint nor the robot has one.
    """
    folder = checkpoint_path(checkpoint)
    carried = folder / ROBOT_FOLDER / CAMERAS
    if carried.is_file():
        return carried
    robot = read_card(folder).robot
    try:
        return share_path('config', 'robots', robot, 'cameras.yaml')
    except ConfigError as error:
        raise CalibrationError(
            f"checkpoint '{checkpoint}' has no default calibration (its episodes were recorded "
            "with different ones): set 'calibration_file' (on commands, --calibration) to that of "
            f"the cameras as they stand now, e.g. an episode's calibration.yaml ({error})"
        ) from error


def assemble_policy(name: str | Path, robot: RobotModel) -> PolicyMaker:
    """Returns what makes the policy of a name.

    Args:
        name: YAML file, name of one in `config/policies`, or a scripted policy such as
            `expert-noise-0.02`.
        robot: the robot that the policy moves.

    Raises:
        ConfigError, PolicyError: no such policy, or its file is wrong.
    """
    config = policy_settings(name, robot)
    if isinstance(config, ScriptedPolicySettings):
        return policy_kind(config.kind).policy_maker(config, robot)
    if isinstance(config, RecordedPolicySettings):
        return partial(_recorded, config, robot)
    made = config.make()
    return lambda origin: made


def policy_settings(name: str | Path, robot: RobotModel) -> PolicyConfig:
    """Returns the settings of the policy of a name, checked; no server is asked.

    Raises:
        ConfigError, PolicyError: as in `assemble_policy`.
    """
    if str(name).startswith('expert'):
        config: PolicyConfig = ScriptedPolicySettings(variant=str(name))
    else:
        config = load_policy_config(bundled('policies', name, 'policy'), robot)
    if isinstance(config, ScriptedPolicySettings):
        policy_kind(config.kind).check(config)
    return config


def _recorded(
    settings: RecordedPolicySettings, robot: RobotModel, origin: EpisodeOrigin
) -> RecordedPolicy:
    from mtv_world_ros.data.episode_reader import read_episode
    from mtv_world_ros.data.recording import stitched_commands

    if not origin.recording:
        raise PolicyError(
            "policy 'recorded' repeats the commands of the episode that it begins from, and there "
            "is none: give --episodes instead of --live, or set the parameter 'recording'"
        )
    episode = read_episode(Path(origin.recording), with_cameras=False, with_masks=False)
    commands = stitched_commands(episode, robot, origin.recording_ns)
    return RecordedPolicy(commands, settings.hold_s)


def asked_describer(file: str | Path | None) -> Describer | None:
    """Returns the describer of `--describer` or the parameter `describer`; None = none is asked.

    Raises:
        ConfigError, CheckpointError: see `assemble_describer`.
    """
    return assemble_describer(file) if file else None


def assemble_describer(config: DescriberConfig | str | Path | None = None) -> Describer:
    """Returns what names the objects of a scene; by default the instruction's words alone.

    Args:
        config: a configuration, or a YAML file like `config/describer.yaml`.

    Raises:
        ConfigError: the configuration is wrong, a key or a package is missing.
    """
    from mtv_world_ros.vision.describers.describer_config import (
        DescriberConfig,
        load_describer_config,
        load_object_list,
    )

    if config is None:
        return InstructionDescriber()
    if not isinstance(config, DescriberConfig):
        config = load_describer_config(Path(config))
    if config.kind == 'list':
        return load_object_list(Path(config.list))
    if config.kind != 'openai' or not config.openai:
        return InstructionDescriber()
    from mtv_world_ros.vision.describers.openai_chat import OpenAIChat
    from mtv_world_ros.vision.describers.vlm import DescriptionCache, VlmDescriber

    cache = DescriptionCache(Path(config.cache)) if config.cache else None
    return VlmDescriber(OpenAIChat(config.openai), cache)
